"""RGB images: their form, and values that are not what they seem."""

import pytest
import torch

from lerobot_policy_pi05_geometry.data.images import ImageRangeCheck, prepare_images
from tests.entry_points import FRONT, WRIST, make_batch, make_config, make_policy

CPU = torch.device("cpu")


def test_images_are_scaled_resized_and_padded_with_black():
    config = make_config()
    config.validate_features()
    batch = make_batch() | {FRONT: torch.ones(2, 3, 14, 28), WRIST: torch.zeros(2, 3, 56, 56)}
    (front, wrist), masks = prepare_images(batch, config, CPU)
    assert front.shape == wrist.shape == (2, 3, 28, 28)
    torch.testing.assert_close(front[:, :, 7:21], torch.ones(2, 3, 14, 28))
    assert front[:, :, :7].eq(-1).all()
    assert front[:, :, 21:].eq(-1).all()
    assert wrist.eq(-1).all()
    assert all(mask.all() for mask in masks)


def test_an_absent_camera_is_none_and_masked():
    config = make_config(absent_cameras=[WRIST], empty_cameras=1)
    config.validate_features()
    batch = make_batch()
    del batch[WRIST]
    images, masks = prepare_images(batch, config, CPU)
    assert [image is None for image in images] == [False, True, True]
    assert [mask.tolist() for mask in masks] == [[True, True], [False, False], [False, False]]


def check(front: torch.Tensor) -> None:
    config = make_config()
    config.validate_features()
    ImageRangeCheck()(make_batch() | {FRONT: front}, config)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda image: image * 255, r"scaled to 0\.\.255"),
        (lambda image: (image * 255).round().int(), r"scaled to 0\.\.255"),
        (lambda image: image * 2 - 1, r"scaled to \[-1, 1\]"),
        (lambda image: image * 1.5, "to 1.5"),
        (lambda image: image.where(image < 0.9, torch.nan), "nan"),
        (lambda image: image.where(image < 0.9, torch.inf), "inf"),
    ],
)
def test_images_out_of_range_are_refused(change, told):
    image = torch.linspace(0, 1, 2 * 3 * 30 * 40).reshape(2, 3, 30, 40)
    check(image)
    with pytest.raises(ValueError, match=rf"{FRONT} has values from .*{told}.*floats in \[0, 1\]"):
        check(change(image))


@pytest.mark.parametrize("image", [torch.zeros(2, 3, 30, 40), torch.ones(2, 3, 30, 40) + 0.01])
def test_black_images_and_a_slight_overshoot_are_fine(image):
    check(image)
    check((image.clamp(0, 1) * 255).to(torch.uint8))


def test_images_are_checked_in_the_first_batch_of_an_episode_and_of_training():
    """Once: a look at every image of every batch would cost more than it finds."""
    policy, batch = make_policy(), make_batch()
    bad = batch | {WRIST: batch[WRIST] * 255}
    for run in (policy.predict_action_chunk, policy.select_action, policy.forward):
        policy.reset()
        with pytest.raises(ValueError, match=WRIST):
            run(bad)
        run(batch)
        run(bad)
