"""Invariant 8: the runner equals the plain path, for any observation."""

import copy

import pytest
import torch
from hypothesis import given, settings
from torch import nn

from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig
from tests.inference.chunks import draw, fast
from tests.model.helpers import (
    EVERY_GEOMETRY,
    IN_PREFIX,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Case,
    build_network,
    cases,
    name_of,
    randomise,
    sample,
)

CONFIGURATIONS = [None, *EVERY_GEOMETRY]
RUNNERS: dict[str, ChunkRunner] = {}


def runner_of(geometry: GeometrySegmentConfig | None) -> ChunkRunner:
    """One runner per configuration, kept over examples: what one observation leaves behind must not reach the next."""
    if name_of(geometry) not in RUNNERS:
        RUNNERS[name_of(geometry)] = ChunkRunner(build_network(geometry, seed=31).eval())
    return RUNNERS[name_of(geometry)]


@pytest.mark.parametrize("geometry", CONFIGURATIONS, ids=name_of)
@given(case=cases)
@settings(max_examples=4)
def test_the_runner_equals_the_plain_path(geometry: GeometrySegmentConfig | None, case: Case) -> None:
    runner = runner_of(geometry)
    batch = draw(runner.network, case)
    expected, found = sample(runner.network, batch, num_steps=3), fast(runner, batch)
    assert (expected - found).abs().max() <= 1e-6 * max(1.0, expected.abs().max())


@pytest.mark.parametrize("geometry", [None, SEGMENT, IN_PREFIX], ids=name_of)
def test_without_geometry_tokens_it_is_the_network_without_geometry(geometry: GeometrySegmentConfig | None) -> None:
    runner = runner_of(geometry)
    batch = Case(seed=3, batch=2).draw(runner.network.geometry_width).without_geometry
    assert (sample(runner.network, batch, num_steps=3) - fast(runner, batch)).abs().max() < 2e-6


@pytest.mark.parametrize("num_steps", [1, 4, 10])
def test_any_number_of_steps(num_steps: int) -> None:
    runner = runner_of(SEGMENT)
    batch = draw(runner.network, Case(seed=4, batch=2))
    expected = sample(runner.network, batch, num_steps=num_steps)
    assert (expected - fast(runner, batch, num_steps)).abs().max() < 2e-6


def test_the_same_observation_gives_the_same_bits_whatever_came_between() -> None:
    runner = runner_of(PARALLEL)
    first, second = (draw(runner.network, Case(seed=seed, batch=size)) for seed, size in ((5, 2), (6, 3)))
    before = fast(runner, first)
    fast(runner, second)
    assert torch.equal(fast(runner, first), before)


@pytest.mark.parametrize("param_dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("geometry", [SEGMENT, None], ids=name_of)
def test_in_bf16_it_is_as_near_to_float32_as_the_plain_path_is(
    geometry: GeometrySegmentConfig | None, param_dtype: torch.dtype
) -> None:
    """bf16 rounds both, differently: neither is the truth. The runner may be at most 1.5 times as far from float32."""
    exact = build_network(geometry, seed=41).eval()
    rounded = build_network(geometry, seed=41, dtype=torch.bfloat16, param_dtype=param_dtype).eval()
    runner = ChunkRunner(rounded)
    far = {"plain": 0.0, "fast": 0.0}
    for seed in range(6):
        batch = draw(exact, Case(seed=seed, batch=2))
        truth = sample(exact, batch, num_steps=3)
        far["plain"] += (sample(rounded, batch, num_steps=3) - truth).square().mean().item()
        far["fast"] += (fast(runner, batch) - truth).square().mean().item()
    assert 0 < far["fast"] < 1.5**2 * far["plain"]


# --- weights ------------------------------------------------------------------------------------------------------


def storage_bytes(network: nn.Module) -> int:
    storages = {p.untyped_storage().data_ptr(): p.untyped_storage().nbytes() for p in network.parameters()}
    return sum(storages.values())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_joined_matrices_are_the_networks_own_storage(dtype: torch.dtype) -> None:
    network = build_network(OWN_EXPERT, dtype=dtype, param_dtype=dtype).eval()
    before, weights = storage_bytes(network), copy.deepcopy(network.state_dict())
    runner = ChunkRunner(network)
    assert storage_bytes(network) == before
    matrices = [m for layers in runner._layers.values() for w in layers for m in (w.qkv, w.gate_up)]
    joined = {m.untyped_storage().data_ptr() for m in matrices}
    assert joined <= {p.untyped_storage().data_ptr() for p in network.parameters()}
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, weights[name]), name
    again = ChunkRunner(network)  # finds them joined already
    assert again._layers[0][0].qkv.data_ptr() == runner._layers[0][0].qkv.data_ptr()


@pytest.mark.parametrize("acting", [torch.no_grad, torch.inference_mode])
def test_a_network_that_has_run_still_trains(acting) -> None:
    """Gradients of joined weights are those of single ones. LeRobot's evaluation in training acts in inference mode."""
    joined, single = (build_network(SEGMENT, seed=61) for _ in range(2))
    batch = draw(joined, Case(seed=8, batch=2))
    with acting():
        fast(ChunkRunner(joined.eval()), batch)
    joined.train()
    for network in (joined, single):
        network(*batch).mean().backward()
    for (name, a), (_, b) in zip(joined.named_parameters(), single.named_parameters(), strict=True):
        assert (a.grad is None) == (b.grad is None), name
        assert a.grad is None or torch.equal(a.grad, b.grad), name


def test_a_network_in_training_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a network in evaluation mode; call eval"):
        ChunkRunner(build_network(SEGMENT).train())


def test_a_runner_of_another_seed_is_another_policy() -> None:
    """The comparisons above can fail."""
    batch = draw(runner_of(SEGMENT).network, Case(seed=11, batch=2))
    other = build_network(SEGMENT, seed=32).eval()
    randomise(other, 5)
    assert (fast(runner_of(SEGMENT), batch) - fast(ChunkRunner(other), batch)).abs().max() > 1e-2
