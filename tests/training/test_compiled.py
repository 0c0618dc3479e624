"""Compiled training computes what training computes, in a few graphs without a break that serve every layer and every prompt.

Graphs are captured as in a real run and executed operation by operation (`eager`), which takes no compiler. `test_generated_code`
compiles them.
"""

import copy
from contextlib import contextmanager

import pytest
import torch
import torch._dynamo as dynamo
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel

from lerobot_policy_pi05_geometry.model import PI05Pytorch
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import TOKEN_MASK, TOKENS, chunk_of, make_batch, make_config, make_policy
from tests.geometry.da3.tiny import write_tiny
from tests.training.test_micro_batches import assert_same, gradients, padded_batch

RGBD = {"geometry_dropout": 0.3, "image_dropout": 0.3, "camera_dropout": 0.3}
# vision, and of the prefix, of geometry and of the suffix a middle and a last layer; those of prefix and geometry have no output
KINDS = 1 + 2 + 2 + 1
VIEW = 1  # In float32 the suffix's first input is a view of what the action projection returned: a graph of its own.
FROZEN = 1  # The prefix's first input needs no gradient where embeddings and vision are frozen; its later ones do.


@pytest.fixture(autouse=True)
def nothing_compiled():
    dynamo.reset()
    yield
    dynamo.reset()


@contextmanager
def captured(backend: str = "eager"):
    """Count the graphs that are captured meanwhile, and the breaks in them."""
    dynamo.utils.counters.clear()
    found = {}
    with torch.compiler.set_stance("default", force_backend=backend):
        yield found
    found["graphs"] = dynamo.utils.counters["stats"]["unique_graphs"]
    found["breaks"] = dict(dynamo.utils.counters["graph_break"])


def pair(policy: PI05GeometryPolicy) -> tuple[PI05GeometryPolicy, PI05GeometryPolicy]:
    """A policy in training, at a step in which no attention is measured, and a copy that compiles."""
    policy.train().progress.step.fill_(1)
    compiled = copy.deepcopy(policy)
    next(m for m in compiled.modules() if isinstance(m, PI05Pytorch)).compile_training()
    return policy, compiled


def prompt_of(length: int, size: int, seed: int = 0) -> dict:
    """A batch whose longest prompt has so many tokens."""
    batch = padded_batch(size, seed)
    batch[TOKENS] = torch.randint(0, 1024, (size, length), generator=torch.Generator().manual_seed(seed))
    batch[TOKEN_MASK] = torch.arange(length)[None] < (length - torch.arange(size) % 3)[:, None]
    return batch


def step(policy: PI05GeometryPolicy, batch: dict, weight: float = 1.0):
    policy.zero_grad()
    loss, info = policy.forward(batch)
    (weight * loss).backward()
    return loss.detach(), gradients(policy), info


def assert_equal_steps(plain, compiled, batch, tolerance: float = 1e-6) -> None:
    (loss, expected, info), (found_loss, found, found_info) = step(plain, batch), step(compiled, batch)
    torch.testing.assert_close(found_loss, loss, atol=tolerance, rtol=tolerance)
    assert found_info.keys() == info.keys()
    for name, value in info.items():
        assert found_info[name] == pytest.approx(value, rel=1e-4), name
    assert_same(found, expected, tolerance)


def make_lora(folder, **changes) -> PI05GeometryPolicy:
    """As lerobot-train makes it of --peft, with adapters that do something."""
    pytest.importorskip("peft")
    make_policy().save_pretrained(folder)
    config = make_config(lora_targets="expert+vlm", **changes)
    config.pretrained_path = folder
    policy = PI05GeometryPolicy.from_pretrained(folder, config=config)
    policy = policy.wrap_with_peft(peft_cli_overrides={"r": 4, "method_type": "LORA"})
    with torch.no_grad():
        for name, p in policy.named_parameters():
            if "lora_" in name:
                p.copy_(0.1 * torch.randn(p.shape, generator=torch.Generator().manual_seed(len(name))))
    return policy


def make_da3(folder, **changes) -> PI05GeometryPolicy:
    path = write_tiny(folder / "DA3-TINY" / "model.safetensors").parent
    return make_policy(
        geometry_source="da3", da3_encoder=str(path), da3_image_size=42, da3_dtype="float32", calibration={}, **changes
    )


SOME = [
    (None, {"gradient_checkpointing": True, "flow_samples": 2, **RGBD}, KINDS + VIEW),
    (make_lora, {"micro_batch_size": 3, "train_expert_only": True}, KINDS + VIEW + FROZEN),
]
MORE = [
    (None, {"micro_batch_size": 2, "train_expert_only": True, "geometry_expert": "own", **RGBD}, KINDS + VIEW),
    (None, {"geometry_source": "none", "freeze_vision_encoder": True}, KINDS - 2 + VIEW),
    (make_da3, {"gradient_checkpointing": True, "micro_batch_size": 2}, KINDS + VIEW),
    (make_lora, {"gradient_checkpointing": True}, KINDS + VIEW + FROZEN),
]


@pytest.mark.parametrize(
    ("make", "changes", "kinds"), SOME + [pytest.param(*more, marks=pytest.mark.long) for more in MORE]
)
def test_loss_and_gradients_are_those_of_training_as_it_is(make, changes, kinds, tmp_path):
    """For several prompt lengths and batch sizes, none of which needs another graph.

    In a step that measures attention the layers with hooks are called as they are: a hook would not run inside a graph.
    """
    plain, compiled = pair(make_policy(**changes) if make is None else make(tmp_path, **changes))
    with captured() as found:
        assert_equal_steps(plain, compiled, prompt_of(7, 6))
    assert found == {"graphs": kinds, "breaks": {}}
    with captured() as found:
        for length, size, seed in ((7, 6, 1), (9, 6, 2), (5, 12, 3), (13, 12, 4)):
            assert_equal_steps(plain, compiled, prompt_of(length, size, seed))
        for policy in (plain, compiled):
            policy.progress.step.zero_()
        assert_equal_steps(plain, compiled, prompt_of(7, 6))
    assert found == {"graphs": 0, "breaks": {}}


@pytest.mark.long
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_generated_code(dtype, backend):
    """Forward and backward graphs, and the code that a compiler makes of them, for a batch of one too."""
    plain, compiled = pair(make_policy(dtype=dtype, gradient_checkpointing=True, **RGBD))
    with captured(backend) as found:
        for length, size in ((7, 6), (9, 4), (9, 1), (12, 1)):
            batch = prompt_of(length, size)
            (loss, expected, _), (found_loss, gradient, _) = step(plain, batch), step(compiled, batch)
            if dtype == "float32":
                torch.testing.assert_close(found_loss, loss, atol=1e-5, rtol=1e-5)
                assert_same(gradient, expected, 1e-5)
                continue
            torch.testing.assert_close(
                found_loss, loss, atol=0.02, rtol=0.02
            )  # generated code rounds to bf16 less often
            for name, expectation in expected.items():
                assert (gradient[name] - expectation).norm() <= 0.05 * expectation.norm() + 1e-4, name
    assert found["breaks"] == {}
    assert found["graphs"] <= 2 * (KINDS + VIEW)


def test_acting_and_evaluation_stay_as_they_are():
    """Whatever compile_model says: bit for bit, and nothing is compiled."""
    plain, compiled = make_policy(), make_policy(compile_model=True)
    assert compiled.model.paligemma_with_expert.compiled
    batch = make_batch()
    with captured() as found:
        assert torch.equal(chunk_of(compiled, batch), chunk_of(plain, batch))
        assert torch.equal(chunk_of(compiled, batch, runner="plain"), chunk_of(plain, batch, runner="plain"))
        assert torch.equal(compiled.forward(batch)[0], plain.forward(batch)[0])
        with torch.no_grad():
            assert torch.equal(compiled.train().forward(batch)[0], plain.train().forward(batch)[0])
    assert found == {"graphs": 0, "breaks": {}}


@pytest.mark.long
@pytest.mark.parametrize("checkpointing", [True, False])
def test_under_ddp(tmp_path, checkpointing):
    """A graph is not cut at DDP's buckets, where a layer that runs again for checkpointing would be another."""
    plain, compiled = pair(make_policy(gradient_checkpointing=checkpointing))
    batch = padded_batch(4)
    _, expected, _ = step(plain, batch)
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'rendezvous'}", rank=0, world_size=1)
    try:
        wrapped = DistributedDataParallel(compiled, find_unused_parameters=True, bucket_cap_mb=0.01)
        for _ in range(2):
            compiled.zero_grad()
            with captured("aot_eager") as found:
                wrapped(batch)[0].backward()
            assert_same(gradients(compiled), expected)
        assert found == {"graphs": 0, "breaks": {}}
    finally:
        dist.destroy_process_group()
