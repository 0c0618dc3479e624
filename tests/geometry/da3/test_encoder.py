"""Frozen means frozen, and the precision is what it says."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchvision.transforms import functional as torchvision

from lerobot_policy_pi05_geometry.geometry.da3.encoder import Da3Encoder, resize, store_products_in
from tests.geometry.da3.tiny import single_view_backbone, tiny_backbone, tiny_encoder
from tests.geometry.scenes import generator, seeds


def images_of(seed: int, batch: int = 2, views: int = 2, size: int = 28) -> torch.Tensor:
    return torch.rand(batch, views, 3, size, size, generator=generator(seed))


def test_no_gradient_ever_reaches_it():
    encoder, images = tiny_encoder(), images_of(0).requires_grad_()
    with torch.enable_grad():
        features = encoder(images)
    assert not features.requires_grad
    assert not any(parameter.requires_grad for parameter in encoder.parameters())


def test_it_stays_in_evaluation_mode():
    encoder = tiny_encoder()
    for _ in range(2):
        assert not any(module.training for module in encoder.modules())
        encoder.train()
    torch.nn.Sequential(encoder).train()
    assert not any(module.training for module in encoder.modules())


@given(seeds)
def test_images_are_normalised_as_imagenets(seed):
    encoder, images = tiny_encoder(seed), images_of(seed)
    normalised = torchvision.normalize(images, [0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    torch.testing.assert_close(encoder(images), encoder.backbone(normalised)[-1], atol=1e-4, rtol=1e-4)


@given(seeds, st.sampled_from([tiny_backbone, single_view_backbone]))
def test_weights_stored_in_bfloat16_give_what_autocast_gives(seed, make):
    images = images_of(seed)
    stored = make(seed)
    store_products_in(stored, torch.bfloat16)
    assert {p.dtype for p in stored.parameters()} == {torch.bfloat16, torch.float32}
    expected = Da3Encoder(make(seed), torch.bfloat16)(images)
    found = Da3Encoder(stored, torch.bfloat16)(images)
    assert found.dtype == torch.float32
    assert torch.equal(found, expected)
    exact = Da3Encoder(make(seed), torch.float32)(images)
    assert 0 < (found - exact).norm() / exact.norm() < 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_callers_autocast_changes_nothing(dtype):
    encoder, images = tiny_encoder(dtype=dtype), images_of(0)
    expected = encoder(images)
    for enabled in (True, False):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            assert torch.equal(encoder(images), expected)


@given(seeds, st.integers(10, 60), st.integers(10, 60))
def test_resizing_keeps_constants_and_range_and_pads_nothing(seed, height, width):
    random = generator(seed)
    image = torch.rand(1, 3, height, width, generator=random).round()  # edges, at which bicubic overshoots
    resized = resize(image, 28)
    assert resized.shape == (1, 3, 28, 28)
    assert resized.min() >= 0
    assert resized.max() <= 1
    constant = torch.rand(1, 3, 1, 1, generator=random).expand(1, 3, height, width)
    torch.testing.assert_close(resize(constant, 28), constant[:, :, :1, :1].expand(1, 3, 28, 28))
    assert torch.equal(resize(resized, 28), resized)


def test_shrinking_looks_at_every_pixel():
    """Without antialiasing, most pixels of a large image would be skipped."""
    image = torch.zeros(1, 3, 112, 112)
    seen = [resize(image.index_fill(3, torch.tensor([column]), 1.0), 28).sum().item() for column in range(40, 60)]
    assert min(seen) > 0.5 * max(seen)
