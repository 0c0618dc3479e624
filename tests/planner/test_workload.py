"""Predicted bytes: equal to those that are there, and moving the way they must."""

import gc
import weakref

import pytest
import torch

from lerobot_policy_pi05_geometry.geometry.camera import Mount
from lerobot_policy_pi05_geometry.geometry.da3 import VARIANTS
from lerobot_policy_pi05_geometry.geometry.kinematics import Arm, Link, StateJoint
from lerobot_policy_pi05_geometry.geometry.rigid import identity_rows
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.planner.counting import storage_bytes
from lerobot_policy_pi05_geometry.planner.workload import FakePolicy, Load
from tests.entry_points import TOKENS, WRIST_POSE, make_batch, make_calibration, make_config, make_features, without
from tests.planner.allocations import allocated

PROMPT = make_batch()[TOKENS].shape[1]
SETTINGS = [
    {},
    {"train_expert_only": True, "gradient_checkpointing": True},
    {"freeze_vision_encoder": True},
    {"geometry_source": "none"},
    {"geometry_source": "random", "flow_samples": 3},
    {"geometry_time": "denoise", "flow_samples": 2},
    {"geometry_expert": "own"},
    {"dtype": "bfloat16"},
    {"dtype": "bfloat16", "gradient_checkpointing": True},
    {"dtype": "bfloat16", "param_dtype": "bfloat16"},
]
MICRO = {"micro_batch_size": 2}
TRAINING_ONLY = {"flow_samples", "gradient_checkpointing", "train_expert_only"}


def load(size: int, **changes) -> Load:
    return Load(**{"batch_size": size, "prompt_tokens": PROMPT, "target": "cpu"} | changes)


def fake(lora_rank: int | None = None, **changes) -> FakePolicy:
    return FakePolicy(make_config(**changes), lora_rank)


def real(size: int, **changes) -> tuple[PI05GeometryPolicy, dict]:
    """A policy and a batch as `FakePolicy` has them, which knows nothing of an index."""
    policy = PI05GeometryPolicy(make_config(**changes))
    batch = without(make_batch(size), "task", "index")
    return policy, batch


def trained(policy: PI05GeometryPolicy, batch: dict) -> int:
    """Bytes at the peak of the second step of a real policy, as LeRobot makes it."""
    policy.train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())

    def step() -> None:
        policy.forward(batch)[0].backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()

    step()
    before = storage_bytes(
        [*policy.parameters(), *policy.buffers(), *batch.values(), *policy.geometry_log.update_size.previous]
    )
    return before + sum(state_bytes(optimizer)) + allocated(step)


def state_bytes(optimizer) -> list[int]:
    """Of every tensor that an optimiser keeps, but for step counts."""
    kept = [v for state in optimizer.state_dict()["state"].values() for name, v in state.items() if name != "step"]
    tables = [m.qmap for state in optimizer.state.values() for m in state.values() if hasattr(m, "qmap")]
    return [tensor.nbytes for tensor in (*kept, *tables)]


@pytest.mark.parametrize("changes", [*SETTINGS, MICRO | {"dtype": "bfloat16"}], ids=str)
def test_training_equals_the_allocator(changes):
    """The whole step of the real policy, its optimiser's too, to 2 %: drawing and logging are not predicted."""
    policy, batch = real(6, **changes)
    predicted = fake(**changes).training(load(6, micro_batch_size=changes.get("micro_batch_size")))
    assert predicted.total == pytest.approx(trained(policy, batch), rel=0.02)


def test_8_bits_equal_the_allocator():
    pytest.importorskip("torchao")
    policy, batch = real(1, optimizer="adamw8bit", geometry_source="none")
    predicted = fake(optimizer="adamw8bit", geometry_source="none").training(load(1, optimizer="adamw8bit"))
    assert predicted.total == pytest.approx(trained(policy, batch), rel=0.02)


@pytest.mark.parametrize("targets", ["expert", "expert+vlm"])
@pytest.mark.parametrize("dtypes", [{"dtype": "bfloat16", "param_dtype": "bfloat16"}], ids=str)
def test_lora_equals_the_allocator(tmp_path, targets, dtypes):
    """PEFT's policy as lerobot-train makes it: 4 samples, adapters of rank 5."""
    pytest.importorskip("peft")
    changes = {"lora_targets": targets} | dtypes
    policy, batch = real(4, **changes, pretrained_path=tmp_path)
    policy.wrap_with_peft(peft_cli_overrides={"r": 5, "method_type": "LORA"})
    planned = fake(5, **changes)
    assert {n: p.shape for n, p in planned.policy.named_parameters() if p.requires_grad} == {
        n: p.shape for n, p in policy.named_parameters() if p.requires_grad
    }
    assert planned.training(load(4)).total == pytest.approx(trained(policy, batch), rel=0.02)


@pytest.mark.parametrize(
    ("changes", "runner"),
    [(s, "fast") for s in SETTINGS if not TRAINING_ONLY & set(s)] + [(SETTINGS[0], "plain"), (SETTINGS[-1], "plain")],
    ids=str,
)
def test_inference_equals_the_allocator(changes, runner):
    """To 2 %."""
    policy, batch = real(16, inference_runner=runner, **changes)
    del batch["action"]
    policy.predict_action_chunk(batch)
    before = storage_bytes([*policy.parameters(), *policy.buffers(), *batch.values(), *policy.sampler.tensors()])
    measured = before + allocated(lambda: policy.predict_action_chunk(batch))
    predicted = fake(inference_runner=runner, **changes).inference(load(16)).total
    assert predicted == pytest.approx(measured, rel=0.02)


@pytest.mark.parametrize("changes", [{}, *(s for s in SETTINGS if TRAINING_ONLY & set(s))][:4] + SETTINGS[-1:], ids=str)
def test_weights_gradients_and_optimiser_are_exact(changes):
    policy, batch = real(2, **changes)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train().forward(batch)[0].backward()
    gradients = [p.grad for p in policy.parameters() if p.grad is not None]
    optimizer.step()
    planned = fake(**changes)
    split = planned.training(load(2))
    assert split.weights == planned.weights() == storage_bytes([*policy.parameters(), *policy.buffers()])
    assert split.optimiser == sum(state_bytes(optimizer))
    resident = planned.resident(load(2))
    assert (resident.gradients, resident.optimiser) == (storage_bytes(gradients), sum(state_bytes(optimizer)))


@pytest.mark.parametrize(
    "changes", [{"flow_samples": 2}, {"dtype": "bfloat16", "gradient_checkpointing": True}], ids=str
)
def test_more_samples_need_more(changes):
    planned = fake(**changes)
    loads = [load(n, target="cuda") for n in (3, 5)]
    less, most = (planned.training(asked) for asked in loads)
    assert less.total < most.total
    assert less.optimiser == most.optimiser
    assert planned.inference(loads[0]).total < planned.inference(loads[1]).total


def test_checkpointing_lowers_activations():
    kept, recomputed = (fake(gradient_checkpointing=on, dtype="bfloat16").training(load(9)) for on in (False, True))
    assert recomputed.activations < 0.8 * kept.activations
    assert recomputed.optimiser == kept.optimiser


def test_a_planned_policy_is_freed_whole():
    """It is in no cycle with what it has counted, nor held by anything global: planning on and on takes no more memory."""
    planned = fake()
    planned.training(load(2, micro_batch_size=1))
    planned.inference(load(1))
    alive = [weakref.ref(planned.policy), *(weakref.ref(p) for p in planned.policy.parameters())]
    del planned
    gc.collect()
    assert not any(reference() is not None for reference in alive)


def test_what_is_frozen_has_no_gradient_and_no_state():
    whole, part = (fake(train_expert_only=only) for only in (False, True))
    frozen = sum(p.nbytes for n, p in whole.policy.named_parameters() if "paligemma.model" in n and p.requires_grad)
    before, after = whole.resident(load(1)), part.resident(load(1))
    assert (before.gradients - after.gradients, before.optimiser - after.optimiser) == (frozen, 2 * frozen)
    assert before.weights == after.weights
    assert part.training(load(8)).gradients <= after.gradients


@pytest.mark.parametrize("runner", ["fast", "plain"])
def test_inference_has_neither_gradients_nor_optimiser(runner):
    # So long a chunk that denoising is the largest moment, with the cache there.
    config = make_config(chunk_size=400, geometry_source="none", inference_runner=runner)
    split = FakePolicy(config).inference(load(2))
    assert (split.gradients, split.optimiser, split.da3) == (0, 0, 0)
    expert, tokens = config.network().expert, 2 * 4 + PROMPT + config.chunk_size  # two cameras of 2 x 2 patches
    assert split.cache == 2 * expert.depth * 2 * expert.num_kv_heads * tokens * expert.head_dim * 4


def test_matrices_that_the_runner_keeps_are_weights():
    """bf16 copies of the layers' matrices over float32 storage; none where storage is bf16 already."""
    plain, fast = (
        fake(dtype="bfloat16", num_inference_steps=1, inference_runner=runner).inference(load(1))
        for runner in ("plain", "fast")
    )
    network = fake().policy.model.paligemma_with_expert
    matrices = sum(p.numel() for n, p in network.named_parameters() if ".layers." in n and "_proj.weight" in n)
    vision = sum(p.numel() for n, p in network.named_parameters() if "vision" in n and "_proj.weight" in n)
    assert 1 < (fast.weights - plain.weights) / (2 * (matrices - vision)) < 1.2  # norms and modulations beside
    pure = {"dtype": "bfloat16", "param_dtype": "bfloat16"}
    assert fake(**pure).inference(load(16)).weights < 1.1 * fake(**pure).weights()


def test_the_runners_modulations_of_every_denoising_step_are_there():
    few, many = (fake(num_inference_steps=steps).inference(load(1)) for steps in (400, 2000))
    expert = make_config().network().expert
    # Two norms a layer and the last; the three that a norm's linear map gives at once, and them stacked; float32.
    modulations = 1600 * (2 * expert.depth + 1) * (3 + 3) * expert.width * 4
    assert many.total - few.total == pytest.approx(modulations, rel=0.05)  # the embedded flow times beside
    assert many.weights > few.weights  # they outlive the chunk


def test_micro_batches_need_what_one_needs_and_the_gradients():
    planned = fake(geometry_source="none")
    whole, small = (planned.training(load(size)) for size in (12, 2))
    micro = planned.training(load(12, micro_batch_size=2))
    assert small.total < micro.total < whole.total
    gradients, batch = planned.resident(load(2)).gradients, without(make_batch(12), "task", "index")
    assert micro.gradients == gradients
    assert micro.total <= small.total + gradients + storage_bytes(batch.values())
    assert planned.training(load(12, micro_batch_size=99)) == planned.training(load(12, micro_batch_size=0)) == whole


def test_8_bits_lower_the_state():
    planned = fake()
    full, eight = (planned.training(load(2, optimizer=name)) for name in ("adamw", "adamw8bit"))
    assert eight.optimiser < full.optimiser
    with pytest.raises(ValueError, match="knows the optimisers adamw and adamw8bit, not 'sgd'"):
        planned.training(load(2, optimizer="sgd"))


def test_depth_anything_has_a_purpose_of_its_own():
    config = make_config(geometry_source="da3", calibration={}, da3_image_size=42)
    planned = FakePolicy(config, None, VARIANTS["tiny"])
    encoder = planned.policy.geometry.source.encoder
    expected = storage_bytes([*encoder.parameters(), *encoder.buffers()])
    assert planned.training(load(2)).da3 == planned.inference(load(2)).da3 == expected > 0
    assert planned.training(load(2)).weights == planned.weights()


@pytest.mark.parametrize("placement", ["segment", "prefix"])
def test_beside_graphs_what_measures_needs_memory_of_its_own(placement):
    """Whether geometry is measured after the first half of a chunk or, where it stands in the prefix, before."""
    changes = {"geometry_source": "da3", "calibration": {}, "da3_image_size": 42, "geometry_placement": placement}
    planned = FakePolicy(make_config(**changes), None, VARIANTS["tiny"])
    on_cuda, on_cpu = (planned.inference(load(8, target=target)).total for target in ("cuda", "cpu"))
    assert on_cuda - on_cpu > 2**18  # rounding to CUDA's blocks is less than half of it


def test_on_cuda_pure_bf16_layer_norms_are_float32():
    """As CUDA's autocast has it, and the CPU's has not: what the vision tower remembers grows."""
    changes = {"dtype": "bfloat16", "param_dtype": "bfloat16"}
    planned = fake(**changes)
    norms = 2 * 2 + 1  # layers of `tiny`'s vision tower
    seen = 8 * 2 * 4 * 32  # samples, cameras, patches, width
    cuda, cpu = (planned.training(load(8, target=target)).activations for target in ("cuda", "cpu"))
    assert cuda - cpu > 0.5 * norms * 2 * seen


def test_on_cuda_pure_bf16_is_planned_with_gradient_checkpointing():
    """Layers that are run again in the backward pass compute as they did in the forward pass."""
    changes = {"dtype": "bfloat16", "param_dtype": "bfloat16"}
    kept, again = (fake(**changes, gradient_checkpointing=on).training(load(8, target="cuda")) for on in (False, True))
    assert 0 < again.activations < kept.activations


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("case", range(3))
def test_on_a_gpu_within_ten_percent(case):
    from benchmarks.planner import GPU_CASES, measure, predict

    what, size, changes = [c for c in GPU_CASES if c[2].get("train_expert_only") or c[0] == "inference"][case]
    measured = measure(what, size, changes, gpu=True)["bytes"]
    assert predict(what, size, changes, gpu=True).total == pytest.approx(measured, rel=0.1)


def test_a_depth_camera_on_the_arm_is_planned_for():
    """Its pose follows from the raw state."""
    calibration, (inputs, _) = make_calibration(), make_features()
    arm = Arm([Link("base"), Link("hand", "base", identity_rows(), "revolute", "j")], [StateJoint("j", "j.pos", 0)])
    calibration["wrist"].mount = Mount("arm", "hand", identity_rows())
    inputs = without(inputs, WRIST_POSE)
    for cameras in (["wrist"], ["front", "wrist"]):
        config = make_config(
            calibration=calibration, arms={"arm": arm}, input_features=inputs, geometry_cameras=cameras
        )
        config.validate_features()
        policy = FakePolicy(config)
        assert policy.training(load(2)).activations > 0
        assert policy.inference(load(2)).activations > 0
