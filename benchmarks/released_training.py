"""A training step of the released size on a CPU, against LeRobot's π0.5: time and peak memory, for LoRA and for the expert only.

    python -m benchmarks.released_training                  some 16 GB of memory; minutes
    python -m benchmarks.released_training --size small     the same at a small size

Both in bfloat16 with random weights, gradient checkpointing, batches of 1, one camera, and a step of AdamW. LoRA has rank 16 on
the same matrices of expert and VLM, and both train the action and flow-time projections in full. Ours has 64 geometry tokens,
with adapter and gate, on top. Two models do not fit beside each other, so each arm is a process of its own, in turn, round by
round. Time is of the steps after the first. Memory is the largest resident set during the steps, the loaded model included.
Prompts have 100 tokens, which LeRobot pads to 200. The planner's figure is its prediction for such a step on a CPU, without the
0.8 GiB or so that a process with PyTorch and LeRobot holds by itself.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from accelerate import init_empty_weights
from torch import Tensor, nn

from benchmarks.lerobot_pi05 import build_lerobot_pi05
from benchmarks.network import high_water_mark
from benchmarks.training_step import ACTION_DIM, CHUNK, IMAGE_SIZE, VARIANTS, policy_batch, policy_config
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.planner.adapters import add_lora
from lerobot_policy_pi05_geometry.planner.workload import FakePolicy, Load
from lerobot_policy_pi05_geometry.training.lora import peft_targets

RANK = 16
RECIPES: dict[str, dict[str, Any]] = {"lora": {"lora_targets": "expert+vlm"}, "expert": {"train_expert_only": True}}
BF16 = {"dtype": "bfloat16", "param_dtype": "bfloat16", "gradient_checkpointing": True}
IN_FULL = ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out")


def with_random_values(module: nn.Module) -> None:
    """Give parameters without storage some: small random numbers, repeated, since drawing billions takes minutes."""
    drawn = 0.02 * torch.randn(2**20, generator=torch.Generator().manual_seed(0))
    for owner in module.modules():
        for name, parameter in list(owner.named_parameters(recurse=False)):
            if parameter.is_meta:
                values = torch.empty(parameter.numel(), dtype=parameter.dtype)
                for part in values.split(len(drawn)):
                    part.copy_(drawn[: len(part)])
                made = nn.Parameter(values.view(parameter.shape), requires_grad=parameter.requires_grad)
                owner.register_parameter(name, made)


def ours(args: argparse.Namespace) -> tuple[list[nn.Parameter], Callable[[], Tensor]]:
    """Parameters to train, and the loss."""
    config = policy_config(args, **BF16, **RECIPES[args.recipe])
    with init_empty_weights(include_buffers=False):
        policy = PI05GeometryPolicy(config)
    if args.recipe == "lora":
        with torch.device("meta"):
            add_lora(policy, RANK)
    with_random_values(policy)
    policy.train().progress.step.fill_(1)  # a step in which no attention is measured
    batch = policy_batch(args, args.batch, 0)
    return list(policy.parameters()), lambda: policy.forward(batch)[0]


def lerobot(args: argparse.Namespace) -> tuple[list[nn.Parameter], Callable[[], Tensor]]:
    from peft import LoraConfig, inject_adapter_in_model

    vlm, expert = VARIANTS[args.size]
    size, only = IMAGE_SIZE[args.size], args.recipe == "expert"
    with init_empty_weights(include_buffers=False):
        network: nn.Module = build_lerobot_pi05(
            vlm, expert, image_size=size, chunk_size=CHUNK, max_action_dim=ACTION_DIM, dtype="bfloat16", train_expert_only=only,
        )  # fmt: skip
    if args.recipe == "lora":
        targets = peft_targets(policy_config(args, **RECIPES["lora"]))["target_modules"].removeprefix(r"model\.")
        with torch.device("meta"):
            network = inject_adapter_in_model(LoraConfig(r=RANK, target_modules=targets), network)
        for name, parameter in network.named_parameters():
            parameter.requires_grad_("lora_" in name or name.startswith(IN_FULL))
    with_random_values(network)
    network.gradient_checkpointing_enable()
    network.train()
    random = torch.Generator().manual_seed(0)
    B = args.batch
    text = torch.randint(3, 1000, (B, 200), generator=random)
    mask = (torch.arange(200)[None] < args.prompt).expand(B, -1)
    images = [torch.rand(B, 3, size, size, generator=random) * 2 - 1]
    actions, noise = (torch.randn(B, CHUNK, ACTION_DIM, generator=random) for _ in range(2))
    flow_time = torch.rand(B, generator=random)
    present = [torch.ones(B, dtype=torch.bool)]
    return list(network.parameters()), lambda: network(images, present, text, mask, actions, noise, flow_time).mean()


def work(args: argparse.Namespace) -> dict[str, Any]:
    """Seconds of each step, GiB at the peak of all and before them, and how much is trained."""
    parameters, loss = (ours if args.worker == "ours" else lerobot)(args)
    trained = [p for p in parameters if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=1e-5, foreach=False)
    Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts again
    loaded, seconds = high_water_mark(), []
    clock = time.process_time if args.cpu_time else time.perf_counter
    for _ in range(args.steps + 1):
        start = clock()
        with torch.autocast("cpu", torch.bfloat16):
            value = loss()
        value.backward()
        optimizer.step()
        optimizer.zero_grad()
        seconds.append(clock() - start)
    return {
        "seconds": seconds, "peak": high_water_mark(), "loaded": loaded, "trained": sum(p.numel() for p in trained),
        "loss": value.item(),
    }  # fmt: skip


def plan(args: argparse.Namespace) -> dict[str, Any]:
    config = policy_config(args, **BF16, **RECIPES[args.recipe])
    fake = FakePolicy(config, RANK if args.recipe == "lora" else None)
    return {"bytes": fake.training(Load(args.batch, None, args.prompt, target="cpu")).total}


def run_worker(args: argparse.Namespace, worker: str, recipe: str) -> dict[str, Any]:
    """What a process of its own found."""
    command = [sys.executable, "-m", "benchmarks.released_training", "--worker", worker, "--recipe", recipe]
    for name in ("size", "batch", "prompt", "steps"):
        command += [f"--{name}", str(getattr(args, name))]
    found = subprocess.run([*command, *["--cpu-time"] * args.cpu_time], capture_output=True, text=True)
    if found.returncode:
        raise RuntimeError(f"{worker}, {recipe} failed:\n{found.stderr[-2000:]}")
    return json.loads(found.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=("small", "full"), default="full")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--prompt", type=int, default=100)
    parser.add_argument("--steps", type=int, default=2, help="to time in each process, after the first")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--recipes", nargs="+", choices=tuple(RECIPES), default=list(RECIPES))
    parser.add_argument("--cpu-time", action="store_true", help="time that a process has used, not that has passed")
    parser.add_argument("--output", help="write the numbers to this JSON file")
    parser.add_argument("--worker", choices=("ours", "lerobot", "plan"), help=argparse.SUPPRESS)
    parser.add_argument("--recipe", choices=tuple(RECIPES), help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.device = "cpu"
    if args.worker:
        print(json.dumps((plan if args.worker == "plan" else work)(args)))
        return
    result: dict[str, Any] = {"settings": vars(args) | {"threads": torch.get_num_threads()}}
    for recipe in args.recipes:
        runs: dict[str, list[dict[str, Any]]] = {"ours": [], "lerobot": []}
        for _ in range(args.rounds):
            for arm, found in runs.items():
                found.append(run_worker(args, arm, recipe))
        rows = {arm: summary(found) for arm, found in runs.items()}
        predicted = run_worker(args, "plan", recipe)["bytes"] / 2**30
        result[recipe] = rows | {"planner_GiB": predicted, "runs": runs}
        for arm, row in rows.items():
            print(
                f"{recipe:7} {arm:8} {row['seconds']:7.2f} s, peak {row['peak_GiB']:6.2f} GiB ({row['loaded_GiB']:.2f} before "
                f"the first step), {row['trained'] / 1e6:.1f} M parameters trained", flush=True,
            )  # fmt: skip
        time_ratio, memory_ratio = (rows["ours"][name] / rows["lerobot"][name] for name in ("seconds", "peak_GiB"))
        print(
            f"{recipe:7} ours over LeRobot's: time {time_ratio:.2f}, memory {memory_ratio:.2f}; planner {predicted:.2f} GiB"
        )
    if args.output:
        Path(args.output).write_text(json.dumps(result, indent=2))


def summary(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Over the runs of an arm: the median second of a step after the first, and the largest peak."""
    return {
        "seconds": statistics.median(s for run in runs for s in run["seconds"][1:]),
        "peak_GiB": max(run["peak"] for run in runs),
        "loaded_GiB": max(run["loaded"] for run in runs),
        "trained": runs[0]["trained"],
    }


if __name__ == "__main__":
    main()
