"""The planner's predicted peak memory against a measured one.

    python -m benchmarks.planner                    on a CPU, at a size between "small" and the released one
    python -m benchmarks.planner --gpu              on this CUDA device, at the released size

Each case is a process of its own, which builds the real policy, makes one training step so that the optimiser's state is
there, and measures the second one (at inference: the second chunk). On a CPU the measure is what PyTorch's allocator holds at
most, from its profiler's memory events, above what is known to be there before: weights, state and batch. What the process's
resident set has gained by then (VmHWM) is shown beside: there, the C library keeps freed memory, and matrix libraries have
scratch memory. On CUDA the measure is `torch.cuda.max_memory_allocated`.
"""

import argparse
import json
import platform
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from benchmarks.network import high_water_mark
from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.model.config import NetworkConfig
from lerobot_policy_pi05_geometry.model.variants import GemmaVariant, PaliGemmaVariant, VisionVariant
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.planner.configuration import complete
from lerobot_policy_pi05_geometry.planner.counting import MemorySplit, storage_bytes
from lerobot_policy_pi05_geometry.planner.workload import FakePolicy, Load

MIB = 2**20
PROMPT = 60
RANK = 16
VLM = PaliGemmaVariant(
    gemma=GemmaVariant(width=256, depth=6, mlp_dim=1024, num_heads=8, num_kv_heads=1, head_dim=32),
    vision=VisionVariant(width=256, depth=6, mlp_dim=1024, num_heads=4, patch_size=14),
    vocab_size=8192,
)
EXPERT = GemmaVariant(width=128, depth=6, mlp_dim=512, num_heads=8, num_kv_heads=1, head_dim=32)


@dataclass
class MidConfig(PI05GeometryConfig):
    """The policy's configuration with the sizes above."""

    def network(self) -> NetworkConfig:
        return replace(super().network(), paligemma=VLM, expert=EXPERT)


BF16 = {"dtype": "bfloat16"}
PURE_BF16 = {"dtype": "bfloat16", "param_dtype": "bfloat16"}
CHECKPOINTED = {"gradient_checkpointing": True}
EXPERT_ONLY = {"train_expert_only": True}
FROZEN_VISION = {"freeze_vision_encoder": True}
EIGHT_BIT = {"optimizer": "adamw8bit"}
LORA = {"lora_targets": "expert+vlm", "rank": RANK}
EAGER = {"inference_runner": "eager"}
TRAIN, ACT = "training", "inference"
# what, batch size, settings
CPU_CASES: list[tuple[str, int, dict[str, Any]]] = [
    (TRAIN, 2, {}),
    (TRAIN, 8, {}),
    (TRAIN, 16, {}),
    (TRAIN, 2, CHECKPOINTED),
    (TRAIN, 8, CHECKPOINTED),
    (TRAIN, 16, CHECKPOINTED),
    (TRAIN, 8, EXPERT_ONLY),
    (TRAIN, 8, EXPERT_ONLY | CHECKPOINTED),
    (TRAIN, 8, FROZEN_VISION),
    (TRAIN, 8, {"flow_samples": 4}),
    (TRAIN, 8, {"geometry_source": "rgbd"}),
    (TRAIN, 8, {"geometry_source": "none"}),
    (TRAIN, 16, {"micro_batch_size": 4}),
    (TRAIN, 8, EIGHT_BIT),
    (TRAIN, 8, LORA),
    (TRAIN, 8, BF16),
    (TRAIN, 8, BF16 | CHECKPOINTED),
    (TRAIN, 8, PURE_BF16 | LORA | CHECKPOINTED),
    (ACT, 1, {}),
    (ACT, 8, {}),
    (ACT, 1, BF16),
    (ACT, 1, PURE_BF16),
    (ACT, 8, {"geometry_source": "rgbd"}),
    (ACT, 8, {"inference_runner": "plain"}),
]
GPU_CASES: list[tuple[str, int, dict[str, Any]]] = [
    (TRAIN, 1, BF16 | CHECKPOINTED),
    (TRAIN, 8, BF16 | CHECKPOINTED),
    (TRAIN, 32, BF16 | CHECKPOINTED),
    (TRAIN, 4, BF16),
    (TRAIN, 8, BF16 | EXPERT_ONLY | CHECKPOINTED),
    (TRAIN, 8, BF16 | EXPERT_ONLY),
    (TRAIN, 8, PURE_BF16 | CHECKPOINTED),
    (TRAIN, 8, BF16 | EIGHT_BIT | CHECKPOINTED),
    (TRAIN, 32, BF16 | CHECKPOINTED | {"micro_batch_size": 4}),
    (TRAIN, 8, PURE_BF16 | LORA | CHECKPOINTED),
    (ACT, 1, BF16 | EAGER),  # of what graphs keep, PyTorch's statistics see nothing at a replay
    (ACT, 1, PURE_BF16 | EAGER),
]


def make_config(settings: dict[str, Any], gpu: bool) -> PI05GeometryConfig:
    settings = {name: value for name, value in settings.items() if name != "rank"}
    common: dict[str, Any] = {"device": "cuda" if gpu else "cpu", "push_to_hub": False, "geometry_source": "random"}
    if gpu:
        return complete(PI05GeometryConfig(**common | settings), cameras=2, image_size=(480, 640))
    config = MidConfig(**common | {"image_resolution": (112, 112), "tokenizer_path": "none"} | settings)
    return complete(config, cameras=2, image_size=(120, 160))


def predict(what: str, batch: int, settings: dict[str, Any], gpu: bool) -> MemorySplit:
    config, target = make_config(settings, gpu), "cuda" if gpu else "cpu"
    if what == ACT:
        return FakePolicy(config).inference(Load(batch, None, PROMPT, target=target))
    load = Load(batch, config.micro_batch_size, PROMPT, config.optimizer, target)
    return FakePolicy(config, settings.get("rank")).training(load)


def real_batch(policy: PI05GeometryPolicy, size: int, device: str) -> dict[str, Tensor]:
    config, random = policy.config, torch.Generator().manual_seed(0)
    batch = {key: torch.rand(size, *f.shape, generator=random) for key, f in config.image_features.items()}
    batch |= {
        key: 500 + 1000 * torch.rand(size, *f.shape, generator=random) for key, f in config.geometry_features.items()
    }
    batch["observation.state"] = torch.rand(size, *config.input_features["observation.state"].shape, generator=random)
    batch["observation.language.tokens"] = torch.randint(0, 1000, (size, PROMPT), generator=random)
    batch["observation.language.attention_mask"] = torch.ones(size, PROMPT, dtype=torch.bool)
    batch["action"] = torch.randn(size, config.chunk_size, *config.action_feature.shape, generator=random)
    return {key: value.to(device) for key, value in batch.items()}


def measure(what: str, size: int, settings: dict[str, Any], gpu: bool) -> dict[str, float]:
    """Bytes at the peak of the second step or chunk."""
    resident = high_water_mark()
    config = make_config(settings, gpu)
    config.pretrained_path = Path("nowhere")  # LoRA wants one to start from; nothing is read
    with torch.device(config.device):  # drawing the released size's weights takes minutes on a CPU
        policy = PI05GeometryPolicy(config)
    if "rank" in settings:
        policy.wrap_with_peft(peft_cli_overrides={"r": settings["rank"], "method_type": "LORA"})
    policy.train(what == TRAIN)
    batch = real_batch(policy, size, config.device)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params()) if what == TRAIN else None

    def step() -> None:
        if optimizer is None:
            policy.predict_action_chunk(batch)
            return
        with torch.autocast(config.device, torch.bfloat16, enabled=config.dtype == "bfloat16"):
            loss, _ = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()

    step()
    if gpu:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        step()
        return {"bytes": torch.cuda.max_memory_allocated(), "reserved": torch.cuda.max_memory_reserved()}
    resident = (high_water_mark() - resident) * 2**30
    before = storage_bytes([*policy.parameters(), *policy.buffers(), *batch.values(), *kept(policy, optimizer)])
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        step()
    events = [e for e in profiler.profiler.kineto_results.events() if e.name() == "[memory]"]
    now = highest = 0
    for event in sorted(events, key=lambda e: e.start_ns()):
        now += event.nbytes()
        highest = max(highest, now)
    return {"bytes": before + highest, "resident": resident}


def kept(policy: PI05GeometryPolicy, optimizer: torch.optim.Optimizer | None) -> list[Tensor]:
    """What stays between steps: the optimiser's state, the policy's copy of its new parameters; between chunks: the runner's."""
    if optimizer is None:
        return policy.sampler.tensors()
    state = [v for values in optimizer.state_dict()["state"].values() for v in values.values() if isinstance(v, Tensor)]
    tables = [
        moment.qmap for values in optimizer.state.values() for moment in values.values() if hasattr(moment, "qmap")
    ]
    return [*state, *tables, *policy.geometry_log.update_size.previous]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpu", action="store_true", help="the released size, on this CUDA device")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    cases = GPU_CASES if args.gpu else CPU_CASES
    if args.case is not None:
        what, size, settings = cases[args.case]
        print(json.dumps(measure(what, size, settings, args.gpu)))
        return
    device = torch.cuda.get_device_name() if args.gpu else platform.processor() or platform.machine()
    rows = []
    print(f"{'':10}{'batch':>6}{'predicted MiB':>15}{'measured MiB':>14}{'ratio':>7}{'resident MiB':>14}  settings")
    for index, (what, size, settings) in enumerate(cases):
        start = time.perf_counter()
        split = predict(what, size, settings, args.gpu)
        seconds = time.perf_counter() - start
        command = [sys.executable, "-m", "benchmarks.planner", "--case", str(index), *(["--gpu"] if args.gpu else [])]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        measured = json.loads(output.splitlines()[-1])
        ratio = split.total / measured["bytes"]
        told = " ".join(f"{name}={value}" for name, value in settings.items())
        beside = measured.get("resident", measured.get("reserved"))
        print(
            f"{what:10}{size:6}{split.total / MIB:15.1f}{measured['bytes'] / MIB:14.1f}{ratio:7.3f}{beside / MIB:14.1f}  {told}"
        )
        rows.append(
            {"what": what, "batch": size, "settings": settings, "predicted": split.__dict__ | {"total": split.total}}
            | {"measured": measured, "ratio": ratio, "seconds_to_predict": seconds}
        )
        if args.output:  # after every case, so that an interrupted run leaves what it has
            args.output.write_text(json.dumps({"device": device, "torch": torch.__version__, "cases": rows}, indent=1))


if __name__ == "__main__":
    main()
