"""The sampler: which path computes a chunk, and that no chunk is computed from weights that are no longer there."""

import copy
import gc
import logging
import weakref

import pytest
import torch
from torch import Tensor, nn

from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.inference.side_stream import PendingGeometry
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.config import RunnerName
from lerobot_policy_pi05_geometry.model.segments import GeometryTokens
from tests.entry_points import make_batch, make_policy
from tests.inference.chunks import draw, fast
from tests.inference.tape import TapeBackend
from tests.model.helpers import IN_PREFIX, OWN_EXPERT, SEGMENT, Case, build_network, name_of, randomise, sample

# --- weights that change ----------------------------------------------------------------------------------------------


def step_of_training(network: PI05Pytorch) -> None:
    for parameter in network.parameters():
        parameter.grad = torch.randn_like(parameter)
    torch.optim.SGD(network.parameters(), lr=0.05).step()


def step_of_a_fused_optimiser(network: PI05Pytorch) -> None:
    """PyTorch does not count its writes."""
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
    """PyTorch does not count it."""
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
    """The new module may get the address of the old one."""
    for layer in network.paligemma_with_expert.expert.layers:
        shape = layer.mlp.up_proj.in_features, layer.mlp.up_proj.out_features
        dtype = layer.mlp.up_proj.weight.dtype
        layer.mlp.up_proj = nn.Identity()
        layer.mlp.up_proj = nn.Linear(*shape, bias=False, dtype=dtype)


DTYPES = [(torch.float32, torch.float32), (torch.bfloat16, torch.float32), (torch.bfloat16, torch.bfloat16)]


COUNTED = [
    step_of_training,
    another_checkpoint,
    new_parameters,
    new_modules,
    new_modules_where_old_ones_were,
]
NOT_COUNTED = [step_of_a_fused_optimiser, new_tensors, a_write_through_data]


def check_that_it_acts(sampler: ChunkSampler, change, then=lambda sampler: None) -> None:
    """The chunk after a change is that of a copy that has never computed one before."""
    network = sampler._network
    batch = draw(network, Case(seed=7, batch=2))
    before = fast(sampler, batch)
    change(network)
    then(sampler)
    after = fast(sampler, batch)
    assert not torch.allclose(before, after, atol=1e-3)
    assert torch.allclose(after, fast(ChunkRunner(copy.deepcopy(network)), batch), atol=1e-6)


@pytest.mark.parametrize(("dtype", "param_dtype"), DTYPES)
@pytest.mark.parametrize("change", COUNTED, ids=lambda f: f.__name__)
def test_changes_that_pytorch_counts_act_at_once(change, dtype: torch.dtype, param_dtype: torch.dtype) -> None:
    """Whether matrices are joined in place or copied (bf16 over float32)."""
    network = build_network(SEGMENT, seed=51, dtype=dtype, param_dtype=param_dtype).eval()
    check_that_it_acts(ChunkSampler(network), change)


@pytest.mark.parametrize(
    "then", [ChunkSampler.refresh, lambda sampler: sampler.train().eval()], ids=["refresh", "train"]
)
@pytest.mark.parametrize("change", NOT_COUNTED, ids=lambda f: f.__name__)
def test_changes_that_pytorch_does_not_count_act_after_a_refresh_or_training(change, then) -> None:
    network = build_network(SEGMENT, seed=51, dtype=torch.bfloat16).eval()
    check_that_it_acts(ChunkSampler(network), change, then)


@pytest.mark.parametrize(
    "move", [lambda policy: policy.to(torch.float64).to(torch.float32), lambda p: p.to_empty(device="cpu")]
)
def test_a_policy_that_moves_or_changes_its_dtype_leaves_no_runner_behind(move) -> None:
    policy = make_policy()
    policy.predict_action_chunk(make_batch(1))
    assert policy.sampler.tensors()
    move(policy)
    assert not policy.sampler.tensors()


def test_loading_leaves_no_runner_behind() -> None:
    policy = make_policy()
    policy.predict_action_chunk(make_batch(1))
    policy.load_state_dict(policy.state_dict())
    assert not policy.sampler.tensors()


@pytest.mark.parametrize("backend", [None, TapeBackend], ids=["eager", "recorded"])
def test_nothing_outlives_an_evaluation_inside_training(backend) -> None:
    """Neither copies of weights nor recordings."""
    policy = make_policy(dtype="bfloat16").train()
    if backend is not None:
        policy.sampler = ChunkSampler(policy.model, backend)
    policy.eval()
    policy.predict_action_chunk(make_batch(1))
    (runner,) = policy.sampler._runners.values()
    held, copied = weakref.ref(runner), weakref.ref(runner._layers[0][0].down)
    del runner
    policy.train()
    gc.collect()
    assert held() is None
    assert copied() is None


def test_a_policy_saves_and_lists_nothing_of_its_sampler() -> None:
    policy = make_policy()
    policy.predict_action_chunk(make_batch(1))
    assert not list(policy.sampler.parameters())
    assert not any("sampler" in name for name in policy.state_dict())


@pytest.mark.parametrize(("dtype", "param_dtype"), DTYPES)
def test_any_single_parameter_acts_as_it_is_now(dtype: torch.dtype, param_dtype: torch.dtype) -> None:
    """One parameter after the other is changed: no feature of the network is missing in the runner."""
    network = build_network(OWN_EXPERT, seed=52, dtype=dtype, param_dtype=param_dtype).eval()
    sampler = ChunkSampler(network)
    batch = draw(network, Case(seed=7, batch=2))
    moved = 0
    for name, parameter in network.named_parameters():
        before = fast(sampler, batch)
        with torch.no_grad():
            parameter.add_(0.3)
        after = fast(sampler, batch)
        if dtype == torch.float32:
            expected, tolerance = sample(network, batch, num_steps=3), 1e-4  # some changes amplify rounding
        else:  # the plain path rounds differently
            expected, tolerance = fast(ChunkRunner(copy.deepcopy(network)), batch), 1e-6
        assert (after - expected).abs().max() <= tolerance * max(1.0, expected.abs().max()), name
        moved += not torch.equal(before, after)
        with torch.no_grad():
            parameter.sub_(0.3)
    assert moved > 0.7 * len(list(network.parameters()))  # nothing reads those of the prefix's last layer


# --- choosing ---------------------------------------------------------------------------------------------------------


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
    mlp.up_proj = nn.Linear(wrapped.in_features, wrapped.out_features, bias=False)  # as merging a LoRA does
    mlp.up_proj.weight = wrapped.weight
    torch.testing.assert_close(fast(sampler, batch), before, atol=1e-6, rtol=0)
    assert sampler.explain()["runner"] == "active"


def test_what_the_runner_does_not_do_is_done_by_the_plain_path(caplog) -> None:
    network = build_network(SEGMENT, seed=82).eval()
    batch, sampler = draw(network, Case(seed=10, batch=2)), ChunkSampler(network)
    plain = fast(sampler, batch, use_cache=False)
    assert torch.equal(plain, sample(network, batch, num_steps=3, use_cache=False))
    assert torch.equal(fast(sampler, batch, runner="plain"), sample(network, batch, num_steps=3))
    network.train()
    assert torch.equal(fast(sampler, batch), sample(network, batch, num_steps=3))
    assert [r.getMessage() for r in caplog.records] == [
        "The plain path computes the actions, since use_cache=False is the slow reference.",
        "The plain path computes the actions, since the network is in training mode.",
    ]


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


def test_a_copied_sampler_follows_the_copied_network() -> None:
    network = build_network(SEGMENT, seed=85).eval()
    sampler, batch = ChunkSampler(network), draw(network, Case(seed=13))
    before = fast(sampler, batch)
    other_network, other = copy.deepcopy((network, sampler))
    assert not other.tensors()  # recorded graphs cannot be copied
    randomise(other_network, 86)
    assert not torch.allclose(fast(other, batch), before, atol=1e-3)
    assert torch.equal(fast(sampler, batch), before)
