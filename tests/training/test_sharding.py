"""Two processes train as one: DDP and FSDP on the CPU, twenty steps, losses and weights."""

import copy
import os
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor
from torch.distributed.tensor import DTensor
from torch.nn.parallel import DistributedDataParallel

from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.training.geometry_log import GeometryLog
from lerobot_policy_pi05_geometry.training.micro_batches import rows_of
from lerobot_policy_pi05_geometry.training.sharding import fsdp_units, shard
from tests.entry_points import CHUNK, make_batch, make_policy

STEPS, SIZE, PROCESSES = 20, 4, 2
CASES = {
    "ddp": {},
    "ddp, micro-batches": {"micro_batch_size": 1},
    "ddp, expert only, own expert": {"train_expert_only": True, "geometry_expert": "own"},
    "fsdp": {},
    "fsdp, checkpointing": {"gradient_checkpointing": True},
    "fsdp, frozen vision": {"freeze_vision_encoder": True, "flow_samples": 2},
}


def build(case: str) -> PI05GeometryPolicy:
    """The same policy in every process; noise and dropout are keyed by the seed of the run.

    With the usual eps, Adam makes full steps of gradients that are rounding errors alone, which no two sums share.
    """
    eps = {"optimizer_eps": 1e-5, "geometry_eps": 1e-5}
    return make_policy(geometry_dropout=0.5, optimizer_lr=1e-3, **eps, **CASES[case]).train()


def batch_of(step: int) -> dict:
    """A batch of both processes. As many valid steps in each half: LeRobot takes the mean of the processes' means."""
    batch = make_batch(SIZE, seed=step)
    valid = torch.tensor([CHUNK, 2, 3, CHUNK - 1])
    batch["action_is_pad"] = torch.arange(CHUNK)[None] >= valid[:, None]
    return batch


@pytest.mark.parametrize("tokens", ["statistics", "points"])
def test_the_units_are_known_by_the_names_of_their_classes(tokens):
    """LeRobot 0.6.2 wraps by class name; `fsdp_units` by type. Both have to find the same modules."""
    policy = make_policy(geometry_expert="own", geometry_tokens=tokens)
    inner = {
        id(m) for unit in fsdp_units(policy) for m in unit.modules() if type(m).__name__ in policy._fsdp_wrap_modules
    }
    by_name = {id(m) for m in policy.modules() if type(m).__name__ in policy._fsdp_wrap_modules}
    assert {id(unit) for unit in fsdp_units(policy)} <= by_name
    assert by_name == inner


def train(policy: PI05GeometryPolicy, model, rows: slice) -> list[float]:
    """Losses of these rows; the policy's weights move."""
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    losses = []
    for step in range(STEPS):
        loss, _ = model(rows_of(batch_of(step), SIZE, rows))
        loss.backward()
        torch.nn.utils.clip_grad_norm_([p for p in policy.parameters() if p.requires_grad], 1.0)
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        losses.append(loss.item())
    return losses


def whole(tensor: Tensor) -> Tensor:
    return tensor.full_tensor() if isinstance(tensor, DTensor) else tensor.detach().clone()


def process(rank: int, folder: Path) -> None:
    """One of the processes: every case in turn; the first writes losses and weights."""
    torch.set_num_threads(1)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    dist.init_process_group("gloo", init_method=f"file://{folder / 'rendezvous'}", rank=rank, world_size=PROCESSES)
    share = SIZE // PROCESSES
    rows = slice(rank * share, (rank + 1) * share)
    results = {}
    for case in CASES:
        policy = build(case)
        ddp = case.startswith("ddp")
        model = DistributedDataParallel(policy, find_unused_parameters=False) if ddp else shard(policy)
        losses = torch.tensor(train(policy, model, rows))
        dist.all_reduce(losses)
        results[case] = (losses / PROCESSES, {name: whole(p) for name, p in policy.state_dict().items()})
    log = GeometryLog(make_policy().model.paligemma_with_expert, 0)
    without = [[[False, True], [True, False]], [[True, False], [False, False]]][
        rank
    ]  # images are taken on one rank only
    log.went_without(torch.tensor([[5.0, 1.0], [3.0, 9.0]][rank]), torch.tensor(without))
    torch.save(log.numbers(), folder / f"numbers{rank}.pt")
    if rank == 0:
        torch.save(results, folder / "results.pt")
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("processes")
    mp.spawn(process, args=(folder,), nprocs=PROCESSES)
    numbers = [torch.load(folder / f"numbers{rank}.pt", weights_only=True) for rank in range(PROCESSES)]
    return torch.load(folder / "results.pt", weights_only=True) | {"numbers": numbers}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_two_processes_train_as_one(results, case):
    policy = build(case)
    start = copy.deepcopy(policy.state_dict())
    expected = torch.tensor(train(policy, policy, slice(None)))
    losses, weights = results[case]
    torch.testing.assert_close(losses, expected, atol=1e-4, rtol=0)
    assert expected.std() > 1e-2
    assert weights.keys() == start.keys()
    for name, tensor in policy.state_dict().items():
        torch.testing.assert_close(weights[name], tensor, atol=1e-4, rtol=0, msg=name)
    moved = sum(not torch.equal(start[name], tensor) for name, tensor in weights.items())
    assert moved > 20


@pytest.mark.slow
def test_every_process_logs_the_same_losses_of_samples_that_went_without(results):
    """LeRobot averages the log over processes by the place of an entry, so a process must not lack one."""
    first, second = results["numbers"]
    assert list(first.items()) == list(second.items())
    assert first["loss_without_geometry"] == pytest.approx((1.0 + 3.0) / 2)
    assert first["loss_without_images"] == pytest.approx(5.0)


@pytest.mark.parametrize("param_dtype", ["float32", "bfloat16"])
def test_a_unit_is_called_and_has_one_dtype(param_dtype):
    """And none is inside a float32 one, so that every parameter is in exactly one unit, or in the policy's own."""
    policy = make_policy(dtype=param_dtype, param_dtype=param_dtype, geometry_expert="own").train()
    units = fsdp_units(policy)
    called = set()
    for unit in units:
        unit.register_forward_pre_hook(lambda module, _arguments: called.add(module))
    policy.forward(make_batch())
    unread = [m for name, m in policy.named_modules() if m in units and m not in called]
    assert all(not p.requires_grad for module in unread for p in module.parameters())
    taken: set[int] = set()
    for unit in [*units, policy]:
        own = {id(p): p.dtype for p in unit.parameters() if id(p) not in taken}
        assert len(set(own.values())) == 1, type(unit)
        taken |= own.keys()
    assert len(taken) == len(list(policy.parameters()))


@pytest.mark.parametrize("setting", [{"micro_batch_size": 1}, {"compile_model": True}])
def test_what_sharded_parameters_do_not_allow_is_refused(tmp_path, setting):
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'rendezvous'}", rank=0, world_size=1)
    try:
        policy = shard(make_policy(**setting).train())
        with pytest.raises(ValueError, match=f"{next(iter(setting))} does not work with FSDP's sharded parameters"):
            policy(make_batch(2))
    finally:
        dist.destroy_process_group()
