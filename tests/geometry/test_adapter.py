"""The adapter: features to tokens, in float32, with a place for every cell and camera."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.adapter import GeometryAdapter
from lerobot_policy_pi05_geometry.geometry.source import GeometryFeatures
from lerobot_policy_pi05_geometry.model.precision import store_in
from tests.geometry.scenes import generator, seeds

WIDTH, CHANNELS = 16, 5


def random_adapter(grid: int, views: int, seed: int = 0) -> GeometryAdapter:
    """An adapter with every parameter redrawn; LayerNorm's start at 1 and 0 would hide errors."""
    adapter, random = GeometryAdapter(CHANNELS, WIDTH, grid, views), generator(seed)
    with torch.no_grad():
        for parameter in adapter.parameters():
            parameter.copy_(0.5 * torch.randn(parameter.shape, generator=random))
    return adapter


def random_features(seed: int, batch: int, views: int, grid: int) -> GeometryFeatures:
    random = generator(seed)
    return GeometryFeatures(
        torch.randn(batch, views, grid**2, CHANNELS, generator=random),
        torch.rand(batch, views, grid**2, generator=random) < 0.7,
    )


@given(seed=seeds, batch=st.integers(1, 3), views=st.integers(1, 3), grid=st.sampled_from([1, 2, 3, 8]))
def test_cells_stand_camera_by_camera_and_row_by_row(seed, batch, views, grid):
    adapter, geometry = random_adapter(grid, views, seed), random_features(seed, batch, views, grid)
    tokens, pad = adapter(geometry)
    assert tokens.shape == (batch, views * grid**2, WIDTH)
    assert tokens.dtype == torch.float32
    assert torch.equal(pad, geometry.valid.reshape(batch, -1))
    for view in range(views):
        for cell in range(grid**2):
            content = adapter.norm(geometry.features[:, view, cell])
            content = adapter.fc_out(torch.nn.functional.gelu(adapter.fc_in(content)))
            expected = content + adapter.row[cell // grid] + adapter.column[cell % grid] + adapter.view[view]
            torch.testing.assert_close(tokens[:, view * grid**2 + cell], expected)


def test_the_scale_of_the_features_does_not_matter():
    adapter, geometry = random_adapter(3, 2), random_features(0, 2, 2, 3)
    tokens, _ = adapter(geometry)
    scaled, _ = adapter(geometry._replace(features=1000 * geometry.features))
    torch.testing.assert_close(scaled, tokens, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_it_computes_in_float32_whatever_comes_in(dtype):
    adapter, geometry = random_adapter(3, 2), random_features(0, 2, 2, 3)
    geometry = geometry._replace(features=geometry.features.to(dtype))
    expected, _ = adapter(geometry)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        tokens, _ = adapter(geometry)
    assert tokens.dtype == torch.float32
    assert torch.equal(tokens, expected)


def test_it_is_stored_in_float32_whatever_the_rest_is_stored_in():
    adapter = random_adapter(3, 2)
    store_in(adapter, torch.bfloat16)
    assert {parameter.dtype for parameter in adapter.parameters()} == {torch.float32}


def test_every_parameter_learns():
    adapter = random_adapter(3, 2)
    adapter(random_features(0, 2, 2, 3))[0].square().sum().backward()
    for name, parameter in adapter.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name
