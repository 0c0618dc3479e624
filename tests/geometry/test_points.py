"""Tokens from the points of a cell: sampled where they stand, pooled whatever their order, blind to what was not measured."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.adapter import PointAdapter, make_adapter
from lerobot_policy_pi05_geometry.geometry.rgbd import SAMPLES, cell_points, depth_features
from lerobot_policy_pi05_geometry.geometry.source import GeometryFeatures
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import FRONT_DEPTH, chunk_of, make_batch, make_policy

COUNT = SAMPLES**2


@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(5, 40), st.integers(5, 40))
def test_points_are_the_pixels_at_the_centres_of_the_parts(seed, grid, height, width) -> None:
    """Against a loop over cells and parts; NaN in a pixel that was not measured reaches nothing."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(2, 3, height, width, generator=generator)
    valid = torch.rand(2, 1, height, width, generator=generator) < 0.6
    found = cell_points(points.where(valid, torch.nan), valid, grid)
    side = grid * SAMPLES
    for row in range(2):
        for cell in range(grid**2):
            expected = []
            for part in range(COUNT):
                y = (cell // grid) * SAMPLES + part // SAMPLES
                x = (cell % grid) * SAMPLES + part % SAMPLES
                v, u = int((2 * y + 1) * height / (2 * side)), int((2 * x + 1) * width / (2 * side))
                known = bool(valid[row, 0, v, u])
                expected.append([*points[row, :, v, u].tolist(), 1.0] if known else [0.0] * 4)
            assert found.features[row, cell].view(COUNT, 4).tolist() == pytest.approx(torch.tensor(expected))
            assert found.valid[row, cell] == any(point[3] for point in expected)


def adapter(seed: int = 0) -> PointAdapter:
    torch.manual_seed(seed)
    return PointAdapter(4 * COUNT, 24, 3, 2)


def cells(seed: int) -> torch.Tensor:
    """Points (2, 2, 9, 4 N), some not measured, and one cell without any."""
    generator = torch.Generator().manual_seed(seed)
    known = (torch.rand(2, 2, 9, COUNT, 1, generator=generator) < 0.5).float()
    known[0, 0, 4] = 0.0
    points = torch.randn(2, 2, 9, COUNT, 3, generator=generator)
    return torch.cat([points * known, known], dim=-1).flatten(3)


@given(st.integers(0, 10_000))
def test_the_order_of_points_does_not_matter(seed) -> None:
    features = cells(seed)
    order = torch.randperm(COUNT, generator=torch.Generator().manual_seed(seed))
    shuffled = features.unflatten(3, (COUNT, 4))[:, :, :, order].flatten(3)
    torch.testing.assert_close(adapter().embed(shuffled), adapter().embed(features), rtol=0, atol=1e-5)


@given(st.integers(0, 10_000))
def test_a_point_that_was_not_measured_reaches_nothing(seed) -> None:
    """Whatever stands in its place, not even NaN, neither the token nor a gradient."""
    features, found = cells(seed), []
    for value in (0.0, 5.0, float("nan")):
        points = features.unflatten(3, (COUNT, 4)).clone()
        points[..., :3] = points[..., :3].masked_fill(points[..., 3:] == 0, value)
        module = adapter()
        tokens = module.embed(points.flatten(3))
        tokens.square().sum().backward()
        found.append([tokens.detach(), *(p.grad for p in module.parameters() if p.grad is not None)])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
    assert found[0][0].isfinite().all()


@pytest.mark.parametrize("known", [1, 5, COUNT])
def test_a_cell_is_its_measured_points(known) -> None:
    """Those that were not measured take no part in the maximum: the token is that of the others alone."""
    features = cells(2).unflatten(3, (COUNT, 4)).clone()
    features[..., 3] = 1.0
    features[..., known:, :] = 0.0
    for seed in range(3):
        together, alone = (
            adapter(seed).embed(features.flatten(3)),
            adapter(seed).embed(features[..., :known, :].flatten(3)),
        )
        torch.testing.assert_close(together, alone, rtol=0, atol=1e-5)


def test_every_measured_point_matters() -> None:
    """Moving the farthest one moves the token; what statistics of a cell would smooth over is there."""
    features = cells(1)
    features[..., 3::4] = 1.0
    moved = features.clone()
    moved[..., 0] += 3.0
    assert ((adapter().embed(moved) - adapter().embed(features)).abs().amax(dim=-1) > 1e-4).all()


def test_a_policy_with_points(tmp_path) -> None:
    """It trains every new parameter, is saved and loaded bit for bit, and acts without depth as with all of it masked."""
    policy, batch = make_policy(geometry_tokens="points"), make_batch(3)
    assert (policy.geometry.source.feature_dim, policy.geometry.source.points) == depth_features(as_points=True)
    assert isinstance(policy.geometry.adapter, PointAdapter)
    loss, _ = policy.train().forward(batch)
    loss.backward()
    for name, parameter in policy.new_parameters().items():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name
    policy.save_pretrained(tmp_path)
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path)
    assert torch.equal(chunk_of(loaded, batch), chunk_of(policy.eval(), batch))
    nearer = batch | {FRONT_DEPTH: batch[FRONT_DEPTH] * 0.5}
    assert (chunk_of(policy, nearer) - chunk_of(policy, batch)).abs().max() > 1e-4


def test_the_source_decides_the_adapter() -> None:
    plain, points = make_policy().geometry.source, make_policy(geometry_tokens="points").geometry.source
    assert type(make_adapter(points, 24)) is PointAdapter
    assert type(make_adapter(plain, 24)) is not PointAdapter
    tokens, pad = make_adapter(points, 24)(GeometryFeatures(cells(0), torch.ones(2, 2, 9, dtype=torch.bool)))
    assert (tokens.shape, pad.shape) == ((2, 18, 24), (2, 18))
