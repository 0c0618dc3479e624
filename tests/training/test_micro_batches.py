"""A batch in micro-batches is the batch: the same loss, gradients and numbers to log, with the memory of a part."""

import copy

import pytest
import torch
import torch.distributed as dist
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.parallel import DistributedDataParallel

from lerobot_policy_pi05_geometry.geometry.keys import RIG
from lerobot_policy_pi05_geometry.model.gemma import GemmaLayer
from lerobot_policy_pi05_geometry.training.micro_batches import rows_of
from tests.entry_points import CHUNK, WRIST_POSE, make_batch, make_policy


def policies(micro: int, **changes):
    """A policy that takes the batch whole, and one with the same weights that takes it in parts."""
    whole = make_policy(**{"geometry_dropout": 0.5, **changes}).train()
    parts = copy.deepcopy(whole)
    parts.config.micro_batch_size = micro
    return whole, parts


def padded_batch(size: int, seed: int = 0) -> dict:
    """Samples with very different numbers of valid steps: a mean over means would not be the mean."""
    batch = make_batch(size, seed)
    valid = 1 + torch.arange(size) % CHUNK
    batch["action_is_pad"] = torch.arange(CHUNK)[None] >= valid[:, None]
    return batch


def gradients(policy) -> dict[str, torch.Tensor]:
    return {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}


def assert_same(found: dict, expected: dict, tolerance: float = 1e-6) -> None:
    """The same parameters have a gradient, and each differs by `tolerance` of its largest entry at most."""
    assert found.keys() == expected.keys()
    assert expected
    for name, gradient in expected.items():
        difference = (found[name] - gradient).abs().max()
        assert difference <= tolerance * max(1.0, gradient.abs().max()), (name, difference, gradient.abs().max())


@settings(max_examples=10, deadline=None)
@given(
    size=st.integers(3, 7),
    micro=st.integers(1, 3),
    flow_samples=st.sampled_from([1, 2]),
    reduction=st.sampled_from(["mean", "none"]),
    checkpointing=st.booleans(),
    indexed=st.booleans(),
)
def test_loss_gradients_and_log_equal_those_of_the_whole_batch(
    size, micro, flow_samples, reduction, checkpointing, indexed
):
    """Whatever weight the loss, or each sample's, is given afterwards."""
    whole, parts = policies(micro, flow_samples=flow_samples, gradient_checkpointing=checkpointing)
    batch = padded_batch(size)
    if not indexed:
        del batch["index"]  # then noise is keyed by the row in the whole batch
    weights = torch.linspace(0.5, 2.0, size)
    infos = []
    for policy in (whole, parts):
        loss, info = policy.forward(batch, reduction=reduction)
        infos.append((loss.detach(), info))
        ((loss * weights).sum() if reduction == "none" else 3.0 * loss).backward()
    (loss, info), (micro_loss, micro_info) = infos
    torch.testing.assert_close(micro_loss, loss, atol=1e-6, rtol=1e-6)
    assert micro_info.keys() == info.keys()
    for name, value in info.items():
        assert micro_info[name] == pytest.approx(value, rel=1e-5), name
    assert_same(gradients(parts), gradients(whole))


@pytest.mark.parametrize("frozen", [{"train_expert_only": True}, {"geometry_source": "none"}])
def test_what_is_frozen_stays_without_a_gradient(frozen):
    whole, parts = policies(2, **frozen)
    for policy in (whole, parts):
        (2.0 * policy.forward(padded_batch(5))[0]).backward()
    assert_same(gradients(parts), gradients(whole))


@pytest.mark.parametrize("training", [True, False])
def test_evaluation_takes_parts_too(training):
    """Without a graph, and with gradients in evaluation mode."""
    whole, parts = (policy.train(training) for policy in policies(2))
    batch = padded_batch(5)
    with torch.no_grad():
        for reduction in ("mean", "none"):
            torch.testing.assert_close(parts.forward(batch, reduction)[0], whole.forward(batch, reduction)[0])
    sizes = []
    parts.model.register_forward_hook(lambda _m, arguments, _o: sizes.append(len(arguments[2])))
    parts.forward(batch)
    assert sizes == [2, 2, 1]


@pytest.mark.parametrize("outer", [True, False])
def test_bfloat16_compute_under_an_outer_autocast(outer):
    """LeRobot runs forward under accelerate's autocast, which keeps the cast weights for all micro-batches."""
    whole, parts = policies(2, dtype="bfloat16")
    batch = padded_batch(4)
    for policy in (whole, parts):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=outer):
            loss, _ = policy.forward(batch)
        loss.backward()
    expected, found = gradients(whole), gradients(parts)
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        assert (found[name] - gradient).norm() <= 0.05 * gradient.norm() + 1e-4, name


def test_gradients_add_to_those_that_are_there_and_are_handed_over_once():
    whole, parts = policies(2)
    batch = padded_batch(4)
    for policy in (whole, parts):
        for _ in range(2):
            loss, _ = policy.forward(batch)
            loss.backward()
    assert_same(gradients(parts), gradients(whole), 2e-6)
    loss, _ = parts.forward(batch)
    loss.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="one backward pass"):
        loss.backward()


@pytest.mark.parametrize("checkpointing", [False, True])
def test_no_layer_runs_more_often_than_for_the_whole_batch(checkpointing):
    _, parts = policies(2, gradient_checkpointing=checkpointing)
    runs = []
    for module in parts.modules():
        if isinstance(module, GemmaLayer):
            module.register_forward_pre_hook(lambda *_: runs.append(1))
    parts.forward(padded_batch(2))[0].backward()
    once = len(runs)
    runs.clear()
    parts.forward(padded_batch(6))[0].backward()
    assert len(runs) == 3 * once


@pytest.mark.parametrize("find_unused", [True, False])
def test_under_ddp_every_gradient_is_reduced_once(tmp_path, find_unused):
    """DDP sees one gradient per parameter and step, whole."""
    whole, parts = policies(2)
    batch = padded_batch(5)
    whole.forward(batch)[0].backward()
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'rendezvous'}", rank=0, world_size=1)
    try:
        wrapped = DistributedDataParallel(parts, find_unused_parameters=find_unused)
        counts: dict[int, int] = {}
        for p in parts.parameters():
            if p.requires_grad:
                p.register_post_accumulate_grad_hook(lambda p: counts.update({id(p): counts.get(id(p), 0) + 1}))
        for _ in range(2):
            parts.zero_grad()
            wrapped(batch)[0].backward()
        assert_same(gradients(parts), gradients(whole))
        assert set(counts.values()) == {2}
    finally:
        dist.destroy_process_group()


def test_rows_of_leaves_alone_what_belongs_to_the_whole_batch():
    batch = make_batch(4) | {WRIST_POSE: torch.eye(4), "number": torch.tensor(4), "name": "four"}
    rows = rows_of(batch, 4, slice(1, 3))
    assert torch.equal(rows[WRIST_POSE], torch.eye(4))
    assert rows["name"] == "four"
    assert rows["task"] == batch["task"][1:3]
    assert torch.equal(rows["action"], batch["action"][1:3])


@pytest.mark.parametrize("size", [3, 4, 16])
def test_poses_of_samples_are_cut_and_those_of_the_whole_batch_are_not(size):
    """As 4 x 4 or as 16 numbers, also where a batch is as long as a pose."""
    poses = torch.arange(size * 16.0).view(size, 4, 4)
    for per_sample in (poses, poses.flatten(1)):
        assert torch.equal(rows_of({WRIST_POSE: per_sample}, size, slice(1, 3))[WRIST_POSE], per_sample[1:3])
    for of_all in (poses[0], poses[0].flatten()):
        assert torch.equal(rows_of({WRIST_POSE: of_all}, size, slice(1, 3))[WRIST_POSE], of_all)


@pytest.mark.parametrize("size", [3, 4, 16])
def test_rigs_of_samples_are_cut_also_where_a_batch_is_as_long_as_a_pose(size):
    rigs = torch.arange(size)
    assert torch.equal(rows_of({RIG: rigs}, size, slice(1, 3))[RIG], rigs[1:3])
    assert torch.equal(rows_of({RIG: rigs[:, None]}, size, slice(1, 3))[RIG], rigs[1:3, None])


def test_a_negative_size_is_refused():
    with pytest.raises(ValueError, match="micro_batch_size must be 0"):
        make_policy(micro_batch_size=-1)
