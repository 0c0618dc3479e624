"""Invariant 8: the runner equals the plain path, for any observation, and never acts on weights that are no longer there."""

import copy
import logging

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor, nn

from lerobot_policy_pi05_geometry.inference.cuda_graphs import GraphRunner
from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.inference.side_stream import PendingGeometry
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.config import RunnerName
from lerobot_policy_pi05_geometry.model.segments import GeometryTokens
from tests.model.helpers import (
    EVERY_GEOMETRY,
    IN_PREFIX,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Batch,
    Case,
    build_network,
    cases,
    name_of,
    randomise,
    sample,
)

CLEAN = [None, *(geometry for geometry in EVERY_GEOMETRY if geometry.time == "clean")]
DENOISE = next(geometry for geometry in EVERY_GEOMETRY if geometry.time == "denoise")
RUNNERS: dict[str, ChunkRunner] = {}


def fast(run: ChunkRunner | ChunkSampler, batch: Batch, num_steps: int = 3, **kwargs) -> Tensor:
    return run(
        *batch.observation,
        noise=batch.noise,
        num_steps=num_steps,
        geom_embs=batch.geom_embs,
        geom_pad=batch.geom_pad,
        **kwargs,
    )


def draw(network: PI05Pytorch, case: Case) -> Batch:
    batch = case.draw(network.geometry_width)
    return batch.without_geometry if network.config.geometry is None else batch


def runner_of(geometry: GeometrySegmentConfig | None) -> ChunkRunner:
    """One runner per configuration, kept over examples: what one observation leaves behind must not reach the next."""
    if name_of(geometry) not in RUNNERS:
        RUNNERS[name_of(geometry)] = ChunkRunner(build_network(geometry, seed=31).eval())
    return RUNNERS[name_of(geometry)]


@pytest.mark.parametrize("geometry", CLEAN, ids=name_of)
@given(case=cases)
@settings(max_examples=6)
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


def step_of_training(network: PI05Pytorch) -> None:
    for parameter in network.parameters():
        parameter.grad = torch.randn_like(parameter)
    torch.optim.SGD(network.parameters(), lr=0.05).step()


def step_of_a_fused_optimiser(network: PI05Pytorch) -> None:
    """Which writes without leaving a trace in the parameters' versions."""
    for parameter in network.parameters():
        parameter.grad = torch.randn_like(parameter)
    torch.optim.AdamW(network.parameters(), lr=0.05, fused=True).step()


def another_checkpoint(network: PI05Pytorch) -> None:
    other = build_network(network.config.geometry, seed=77)
    network.load_state_dict(other.state_dict())


def new_tensors(network: PI05Pytorch) -> None:
    for parameter in network.parameters():
        parameter.data = parameter.data * 0.9


def a_write_through_data(network: PI05Pytorch) -> None:
    """As averages of weights are kept. Neither versions nor places tell."""
    for parameter in network.parameters():
        parameter.data.mul_(0.9)


def new_parameters(network: PI05Pytorch) -> None:
    for module in network.modules():
        for name, parameter in list(module._parameters.items()):
            if parameter is not None:
                setattr(module, name, nn.Parameter(parameter.detach() * 0.9))


def new_modules(network: PI05Pytorch) -> None:
    for layer in network.paligemma_with_expert.expert.layers:
        shape = layer.mlp.up_proj.in_features, layer.mlp.up_proj.out_features
        layer.mlp.up_proj = nn.Linear(*shape, bias=False, dtype=layer.mlp.up_proj.weight.dtype)


def new_modules_where_old_ones_were(network: PI05Pytorch) -> None:
    """As when something wraps a projection, and hands another one back: nothing of the old one is left, but maybe its address."""
    for layer in network.paligemma_with_expert.expert.layers:
        shape = layer.mlp.up_proj.in_features, layer.mlp.up_proj.out_features
        dtype = layer.mlp.up_proj.weight.dtype
        layer.mlp.up_proj = nn.Identity()
        layer.mlp.up_proj = nn.Linear(*shape, bias=False, dtype=dtype)


DTYPES = [(torch.float32, torch.float32), (torch.bfloat16, torch.float32), (torch.bfloat16, torch.bfloat16)]


@pytest.mark.parametrize(("dtype", "param_dtype"), DTYPES)
@pytest.mark.parametrize(
    "change",
    [
        step_of_training,
        step_of_a_fused_optimiser,
        another_checkpoint,
        new_tensors,
        a_write_through_data,
        new_parameters,
        new_modules,
        new_modules_where_old_ones_were,
    ],
    ids=lambda f: f.__name__,
)
def test_weights_that_changed_after_building_act(change, dtype: torch.dtype, param_dtype: torch.dtype) -> None:
    """Joined in place or copied (bf16 over float32), stale matrices and modulations never act."""
    network = build_network(SEGMENT, seed=51, dtype=dtype, param_dtype=param_dtype).eval()
    runner = ChunkRunner(network)
    batch = draw(network, Case(seed=7, batch=2))
    before = fast(runner, batch)
    change(network)
    after = fast(runner, batch)
    assert not torch.allclose(before, after, atol=1e-3)
    fresh = ChunkRunner(copy.deepcopy(network))
    assert torch.allclose(after, fast(fresh, batch), atol=1e-6)


@pytest.mark.parametrize(("dtype", "param_dtype"), DTYPES)
def test_any_single_parameter_acts_as_it_is_now(dtype: torch.dtype, param_dtype: torch.dtype) -> None:
    """Written through `.data`, in whole, one parameter after the other: what is computed from weights is never kept."""
    network = build_network(OWN_EXPERT, seed=52, dtype=dtype, param_dtype=param_dtype).eval()
    runner = ChunkRunner(network)
    batch = draw(network, Case(seed=7, batch=2))
    moved = 0
    for name, parameter in network.named_parameters():
        before = fast(runner, batch)
        parameter.data.add_(0.3)
        after, fresh = fast(runner, batch), fast(ChunkRunner(copy.deepcopy(network)), batch)
        assert torch.allclose(after, fresh, atol=1e-6), name
        moved += not torch.equal(before, after)
        parameter.data.sub_(0.3)
    assert moved > 0.7 * len(list(network.parameters()))  # some feed nothing: the last layer of prefix and geometry


def test_a_single_entry_acts_where_weights_are_not_copied() -> None:
    network = build_network(SEGMENT, seed=53).eval()
    runner, batch = ChunkRunner(network), draw(network, Case(seed=7, batch=2))
    before = fast(runner, batch)
    network.paligemma_with_expert.expert.layers[0].mlp.down_proj.weight.data[1, 2] += 5.0
    after = fast(runner, batch)
    assert not torch.equal(before, after)
    assert torch.allclose(after, sample(network, batch, num_steps=3), atol=2e-6)


@pytest.mark.parametrize("acting", [torch.no_grad, torch.inference_mode])
def test_a_network_that_has_run_still_trains(acting) -> None:
    """Gradients of joined weights are those of single ones. LeRobot's evaluation in training acts in inference mode."""
    joined, single = (build_network(SEGMENT, seed=61) for _ in range(2))
    batch = draw(joined, Case(seed=8, batch=2))
    with acting():
        fast(ChunkRunner(joined), batch)
    for network in (joined, single):
        network(*batch).mean().backward()
    for (name, a), (_, b) in zip(joined.named_parameters(), single.named_parameters(), strict=True):
        assert (a.grad is None) == (b.grad is None), name
        assert a.grad is None or torch.equal(a.grad, b.grad), name


# --- choosing -----------------------------------------------------------------------------------------------------


class Adapted(nn.Linear):
    """Stands for a projection that something has wrapped, as PEFT does."""

    def forward(self, x: Tensor) -> Tensor:
        return 2 * super().forward(x)


def test_a_wrapped_projection_is_served_by_the_plain_path(caplog) -> None:
    network = build_network(SEGMENT, seed=71).eval()
    sampler = ChunkSampler(network)
    batch = draw(network, Case(seed=9, batch=2))
    assert sampler.explain()["runner"] == "active"
    before = fast(sampler, batch)
    mlp = network.paligemma_with_expert.expert.layers[0].mlp
    wrapped = Adapted(mlp.up_proj.in_features, mlp.up_proj.out_features, bias=False)
    wrapped.weight = mlp.up_proj.weight
    mlp.up_proj = wrapped
    with caplog.at_level(logging.WARNING):
        after = [fast(sampler, batch) for _ in range(2)]
    assert torch.equal(after[0], sample(network, batch, num_steps=3))
    assert torch.equal(after[0], after[1])
    assert not torch.allclose(before, after[0], atol=1e-3)
    assert [r.getMessage() for r in caplog.records] == [
        "The plain path computes the actions, since a projection is a Adapted, not a plain linear layer."
    ]
    assert "declined: a projection is a Adapted" in sampler.explain()["runner"]


def test_what_the_runner_does_not_do_is_done_by_the_plain_path() -> None:
    follows_time = build_network(DENOISE, seed=81).eval()
    batch = draw(follows_time, Case(seed=10, batch=2))
    assert torch.equal(fast(ChunkSampler(follows_time), batch), sample(follows_time, batch, num_steps=3))
    network = build_network(SEGMENT, seed=82).eval()
    plain = fast(ChunkSampler(network), batch, use_cache=False)
    assert torch.equal(plain, sample(network, batch, num_steps=3, use_cache=False))
    assert torch.equal(fast(ChunkSampler(network), batch, runner="plain"), sample(network, batch, num_steps=3))


@pytest.mark.parametrize("geometry", [None, SEGMENT, IN_PREFIX], ids=name_of)
@pytest.mark.parametrize("runner", ["fast", "eager", "plain"])
def test_explain_says_what_a_chunk_did(geometry: GeometrySegmentConfig | None, runner: RunnerName) -> None:
    said = ChunkSampler(build_network(geometry, seed=83).eval()).explain(runner)
    if runner == "plain":
        assert said == {"runner": "declined: inference_runner=plain; the plain path serves"}
        return
    assert said["runner"] == "active"
    assert said["CUDA graphs"] == "declined: a cpu has none"
    before = {None: "none", SEGMENT: "measured after the prefix", IN_PREFIX: "measured before the prefix"}[geometry]
    assert said["geometry"].startswith(before)


@pytest.mark.parametrize("runner", ["fast", "plain"])
def test_pending_geometry_is_measured_once_whoever_computes(runner: RunnerName) -> None:
    network = build_network(SEGMENT, seed=84).eval()
    batch, times = draw(network, Case(seed=12)), []

    def measure() -> GeometryTokens:
        times.append(1)
        return GeometryTokens(batch.geom_embs, batch.geom_pad)

    pending = PendingGeometry(batch.geom_embs.shape[1], measure)
    found = ChunkSampler(network)(*batch.observation, noise=batch.noise, num_steps=3, geometry=pending, runner=runner)
    assert torch.equal(found, fast(ChunkSampler(network), batch, runner=runner))
    assert len(times) == 1


def test_a_network_that_moved_leaves_no_runner_behind() -> None:
    network = build_network(SEGMENT, seed=87).eval()
    sampler, batch = ChunkSampler(network), draw(network, Case(seed=14))
    before = fast(sampler, batch)
    elsewhere = GraphRunner(network)
    elsewhere.device = torch.device("meta")  # as if it had been built on another device
    sampler._runners[GraphRunner] = elsewhere
    assert torch.equal(fast(sampler, batch), before)
    assert list(sampler._runners) == [ChunkRunner]


def test_a_copied_sampler_follows_the_copied_network() -> None:
    network = build_network(SEGMENT, seed=85).eval()
    sampler, batch = ChunkSampler(network), draw(network, Case(seed=13))
    before = fast(sampler, batch)
    other_network, other = copy.deepcopy((network, sampler))
    assert not other._runners  # recorded graphs have no copies
    randomise(other_network, 86)
    assert not torch.allclose(fast(other, batch), before, atol=1e-3)
    assert torch.equal(fast(sampler, batch), before)


def test_a_runner_of_another_seed_is_another_policy() -> None:
    """The comparisons above can fail."""
    batch = draw(runner_of(SEGMENT).network, Case(seed=11, batch=2))
    other = build_network(SEGMENT, seed=32).eval()
    randomise(other, 5)
    assert (fast(runner_of(SEGMENT), batch) - fast(ChunkRunner(other), batch)).abs().max() > 1e-2
