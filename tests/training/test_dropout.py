"""Modality dropout: what a training sample goes without, how often, and that it is never all it has."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.model.flow_matching import FlowDraw
from lerobot_policy_pi05_geometry.training.dropout import Cameras, DropoutRates, drop, went_without

from ..entry_points import FRONT, FRONT_DEPTH, WRIST, WRIST_DEPTH, make_batch, make_features, make_policy

CELLS = 4
NAMES = ("front", "wrist", "left", "right")


def draws(u: torch.Tensor, which: torch.Tensor) -> FlowDraw:
    nothing = torch.zeros(len(u))
    return FlowDraw(nothing, nothing, u, which, nothing, nothing)


@st.composite
def situations(draw):
    """Cameras with images, cameras with cells, which of them give something, draws and rates."""
    size = draw(st.integers(1, 40))
    cameras = Cameras(
        draw(st.lists(st.sampled_from(NAMES), unique=True, min_size=1)),
        draw(st.lists(st.sampled_from(NAMES), unique=True)),
        draw(st.booleans()),
    )
    generator = torch.Generator().manual_seed(draw(st.integers(0, 10_000)))
    flags = lambda *shape: torch.rand(shape, generator=generator) < 0.7  # noqa: E731
    images = [flags(size) for _ in cameras.images]
    cells = (flags(size, len(cameras.geometry), CELLS) & flags(size, len(cameras.geometry), 1)).flatten(1)
    pad = cells if cameras.geometry else None
    third = st.floats(0, 1 / 3)
    rates = DropoutRates(draw(third), draw(third), draw(third))
    return rates, cameras, images, pad, torch.rand(size, generator=generator), torch.rand(size, generator=generator)


def per_camera(
    cameras: Cameras, images: list[torch.Tensor], pad: torch.Tensor | None, row: int
) -> dict[str, list[bool]]:
    """What each camera gives in a row: its image, and its cells."""
    given = {}
    for name, mask in zip(cameras.images, images, strict=True):
        given.setdefault(name, []).append(bool(mask[row]))
    if pad is not None:
        for view, name in enumerate(cameras.geometry):
            given.setdefault(name, []).extend(pad[row].view(-1, CELLS)[view].tolist())
    return given


@given(situations())
def test_against_the_rule_row_by_row(situation) -> None:
    """At most one thing is lost, never the last, nothing comes back, and the draw says which."""
    rates, cameras, images, pad, u, which = situation
    left_images, left_pad = drop(draws(u, which), rates, cameras, images, pad)
    for row in range(len(u)):
        had = per_camera(cameras, images, pad, row)
        had_images = any(mask[row] for mask in images)
        had_cells = pad is not None and bool(pad[row].any())
        expected_images = [bool(mask[row]) for mask in images]
        expected_pad = None if pad is None else pad[row].clone()
        there = [name for name in had if any(had[name])]
        if u[row] < rates.geometry:
            if had_images and pad is not None:
                expected_pad[:] = False
        elif u[row] < rates.geometry + rates.camera:
            if len(there) > 1:
                lost = there[min(int(which[row] * len(there)), len(there) - 1)]
                expected_images = [e and name != lost for e, name in zip(expected_images, cameras.images, strict=True)]
                if pad is not None and lost in cameras.geometry:
                    view = cameras.geometry.index(lost)
                    gone = slice(None) if cameras.across_views else slice(view * CELLS, (view + 1) * CELLS)
                    expected_pad[gone] = False
        elif u[row] >= 1 - rates.images and had_cells:
            expected_images = [False] * len(images)
        assert [bool(mask[row]) for mask in left_images] == expected_images
        if pad is not None:
            assert torch.equal(left_pad[row], expected_pad)
    assert (left_pad is None) == (pad is None)
    if pad is not None:
        expected = [
            [bool(pad[row].any() and not left_pad[row].any()), _any(images, row) and not _any(left_images, row)]
            for row in range(len(u))
        ]
        assert went_without((images, pad), (left_images, left_pad)).tolist() == expected


def _any(masks: list[torch.Tensor], row: int) -> bool:
    return any(bool(mask[row]) for mask in masks)


def test_a_geometry_camera_without_an_image_that_is_lost_across_views_leaves_the_images() -> None:
    """Features that come from all views are all lost with one of them."""
    cameras = Cameras(["front", "wrist"], ["front", "wrist"], across_views=True)
    ones = torch.ones(1, dtype=torch.bool)
    images, pad = drop(
        draws(torch.tensor([0.0]), torch.tensor([0.0])),
        DropoutRates(0.0, 0.0, 0.9),
        cameras,
        [ones, ones],
        ones.repeat(1, 8),
    )
    assert [bool(mask) for mask in images] == [False, True]
    assert not pad.any()


@pytest.mark.parametrize(
    "rates", [DropoutRates(0.2, 0.4, 0.0), DropoutRates(0.1, 0.3, 0.6), DropoutRates(0.5, 0.5, 0.0)]
)
def test_as_often_as_told(rates: DropoutRates) -> None:
    count = 20_000
    generator = torch.Generator().manual_seed(0)
    u, which = torch.rand(count, generator=generator), torch.rand(count, generator=generator)
    ones = torch.ones(count, dtype=torch.bool)
    cameras = Cameras(["front", "wrist"], ["front"], across_views=False)
    images, pad = drop(draws(u, which), rates, cameras, [ones, ones], ones[:, None].repeat(1, CELLS))
    no_images, no_cells = ~images[0] & ~images[1], ~pad.any(dim=1)
    one_image = images[0] ^ images[1]
    # half of the lost cameras are the front one, which takes the cells along
    found = [no_images.float().mean(), one_image.float().mean(), no_cells.float().mean()]
    assert found == pytest.approx([rates.images, rates.camera, rates.geometry + rates.camera / 2], abs=0.015)


# --- in the policy ----------------------------------------------------------------------------------------------------

DROPPED = {
    "images": ({"image_dropout": 0.999999, "geometry_dropout": 0.0}, (FRONT, WRIST)),
    "geometry": ({"image_dropout": 0.0, "geometry_dropout": 0.999999}, (FRONT_DEPTH, WRIST_DEPTH)),
}


@pytest.mark.parametrize("what", DROPPED)
def test_what_is_dropped_reaches_neither_loss_nor_gradients(what) -> None:
    """Invariant 5: not even NaN; every trainable parameter still gets its gradient (invariant 11)."""
    settings, keys = DROPPED[what]
    policy, batch = make_policy(**settings).train(), make_batch(3)
    found = []
    for value in (None, float("nan"), 7.0):
        spoilt = dict(batch)
        if value is not None and what == "images":
            spoilt |= {key: torch.full_like(batch[key], value) for key in keys}
        elif value == 7.0:
            spoilt |= {key: batch[key] * 0.5 for key in keys}
        policy.zero_grad()
        loss, _ = policy.forward(spoilt)
        loss.backward()
        assert all(p.grad is not None for p in policy.parameters() if p.requires_grad)
        found.append([loss.detach(), *(p.grad.clone() for p in policy.parameters() if p.requires_grad)])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_dropped_images_are_a_policy_without_cameras() -> None:
    """The loss of a sample whose images are dropped is that of one whose cameras are absent."""
    policy = make_policy(image_dropout=0.999999, geometry_dropout=0.0).train()
    blind = make_policy(image_dropout=0.0, geometry_dropout=0.0, absent_cameras=[FRONT, WRIST]).train()
    blind.load_state_dict(policy.state_dict())
    batch = make_batch(2)
    without = {key: value for key, value in batch.items() if key not in (FRONT, WRIST)}
    torch.testing.assert_close(policy.forward(batch)[0], blind.forward(without)[0])


def test_nothing_is_dropped_outside_of_training() -> None:
    rates = {"image_dropout": 0.3, "geometry_dropout": 0.3, "camera_dropout": 0.4}
    policy, batch = make_policy(**rates), make_batch(4)
    plain = make_policy(image_dropout=0.0, geometry_dropout=0.0)
    plain.load_state_dict(policy.state_dict())
    assert torch.equal(policy.eval().forward(batch)[0], plain.eval().forward(batch)[0])
    assert not torch.equal(policy.train().forward(batch)[0], plain.train().forward(batch)[0])


def test_a_policy_without_geometry_keeps_its_images() -> None:
    policy = make_policy(geometry_source="none", image_dropout=0.999999, geometry_dropout=0.0).train()
    plain = make_policy(geometry_source="none", image_dropout=0.0).train()
    plain.load_state_dict(policy.state_dict())
    batch = make_batch(2)
    assert torch.equal(policy.forward(batch)[0], plain.forward(batch)[0])


def test_a_camera_whose_image_has_another_name_cannot_be_taken_away() -> None:
    """As after a --rename_map of the images: the depth camera would stay when its image goes."""
    features, _ = make_features()
    renamed = {FRONT: "observation.images.base", WRIST: "observation.images.hand"}
    changes = {"input_features": {renamed.get(key, key): value for key, value in features.items()}}
    make_policy(**changes)
    with pytest.raises(ValueError, match=r"no image \(base, hand\) has the name of a geometry camera \(front, wrist\)"):
        make_policy(**changes, camera_dropout=0.1)
