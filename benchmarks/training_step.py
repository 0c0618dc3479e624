"""A training step with gradient checkpointing against LeRobot's π0.5 with its own; memory of micro-batches; flow samples.

    python -m benchmarks.training_step                     small size, float32
    python -m benchmarks.training_step --size mid          six times wider layers, still for a CPU
    python -m benchmarks.training_step --size full --device cuda    released size, bf16 compute over float32 weights
    python -m benchmarks.training_step --size full --device cuda --arms geometry "geometry, compiled" lerobot "lerobot, compiled"
    python -m benchmarks.training_step --flow-samples 20   loss after 20 s of training at K = 1, 2, 4, 8

The step against LeRobot's is forward and backward, without an optimiser. All arms run the same weights and batch in one
process, in turn, round by round; a ratio is the median over rounds of ours / LeRobot's in the same round. On a machine that
others use too, `--cpu-time` with one thread (OMP_NUM_THREADS=1) counts what this process has used. Memory is the peak of live
tensors in one step, weights and gradients included. Ours pads prompts to what the batch needs (`--prompt`), LeRobot's always to
200: `--prompt 200` takes that apart.

The compiled arms are compile_model=true: ours by layers (model/layer_calls.py), LeRobot's the forward pass as a whole, in its
mode max-autotune or the one given. The first step, which compiles, is reported apart. `--arms` chooses what is run, without
micro-batches.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor, nn

from benchmarks.lerobot_pi05 import build_lerobot_pi05, copy_weights
from benchmarks.memory import peak_memory
from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, NetworkConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.variants import (
    EXPERT_VARIANTS,
    PALIGEMMA_VARIANTS,
    GemmaVariant,
    PaliGemmaVariant,
    VisionVariant,
)
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy

ARMS = ("geometry", "no geometry", "lerobot")  # run unless --arms says otherwise
COMPILED = ", compiled"
ALL_ARMS = (*ARMS, *(arm + COMPILED for arm in ARMS))
CHUNK, ACTION_DIM, GRID = 50, 32, 8
IMAGE_SIZE = {"small": 84, "mid": 112, "full": 224}
VARIANTS = {"small": ("small", "small"), "mid": ("mid", "mid"), "full": ("gemma_2b", "gemma_300m")}
PALIGEMMA_VARIANTS["mid"] = PaliGemmaVariant(
    gemma=GemmaVariant(width=768, depth=6, mlp_dim=3072, num_heads=8, num_kv_heads=1, head_dim=96),
    vision=VisionVariant(width=384, depth=6, mlp_dim=1536, num_heads=6, patch_size=14),
    vocab_size=1024,
)
EXPERT_VARIANTS["mid"] = GemmaVariant(width=384, depth=6, mlp_dim=1536, num_heads=8, num_kv_heads=1, head_dim=96)


# --- against LeRobot --------------------------------------------------------------------------------------------------


def build_networks(args: argparse.Namespace) -> dict[str, nn.Module]:
    """LeRobot's network and ours with its weights, both with gradient checkpointing."""
    vlm, expert = VARIANTS[args.size]
    dtype = torch.bfloat16 if args.size == "full" else torch.float32
    size = IMAGE_SIZE[args.size]
    torch.manual_seed(0)
    with torch.device(args.device):
        lerobot = build_lerobot_pi05(vlm, expert, image_size=size, chunk_size=CHUNK, max_action_dim=ACTION_DIM)
        config = NetworkConfig(
            PALIGEMMA_VARIANTS[vlm], EXPERT_VARIANTS[expert], size, CHUNK, ACTION_DIM, dtype=dtype,
            geometry=GeometrySegmentConfig(),
        )  # fmt: skip
        ours = PI05Pytorch(config)
    copy_weights(lerobot, ours)
    for network in (lerobot.to(args.device), ours.to(args.device)):
        network.gradient_checkpointing_enable()
        network.train()
    return {"lerobot": lerobot, "ours": ours}


def network_steps(args: argparse.Namespace, networks: dict[str, nn.Module]) -> dict[str, Callable[[], None]]:
    """One forward and backward pass of every arm, on the same batch."""
    generator = torch.Generator().manual_seed(1)
    B, size = args.batch, IMAGE_SIZE[args.size]
    images = [torch.rand(B, 3, size, size, generator=generator) * 2 - 1 for _ in range(args.cameras)]
    text = torch.zeros(B, 200, dtype=torch.long)
    text[:, : args.prompt] = torch.randint(3, 1000, (B, args.prompt), generator=generator)
    mask = (torch.arange(200)[None] < args.prompt).expand(B, -1)
    actions, noise = (torch.randn(B, CHUNK, ACTION_DIM, generator=generator) for _ in range(2))
    flow_time = torch.rand(B, generator=generator)
    tokens = torch.randn(B, GRID**2, networks["ours"].geometry_width, generator=generator)
    put = [t.to(args.device) for t in (*images, text, mask, actions, noise, flow_time, tokens)]
    images, (text, mask, actions, noise, flow_time, tokens) = put[: args.cameras], put[args.cameras :]
    present = [torch.ones(B, dtype=torch.bool, device=args.device)] * args.cameras
    short = (text[:, : args.prompt], mask[:, : args.prompt])

    # As LeRobot does on compile_model, but kept apart from the network that runs without.
    lerobot_compiled = torch.compile(networks["lerobot"].forward, mode=args.lerobot_compile_mode)

    def step(arm: str) -> None:
        kind, compiled = arm.removesuffix(COMPILED), arm.endswith(COMPILED)
        network = network_of(arm, networks)
        network.zero_grad()
        prompt = (text, mask) if kind == "lerobot" else short
        geometry = (tokens,) if kind == "geometry" else ()
        networks["ours"].paligemma_with_expert.compiled = compiled
        call = lerobot_compiled if arm == "lerobot" + COMPILED else network
        # bf16 compute of LeRobot's is what accelerate gives it; ours switches autocast on by itself.
        with torch.autocast(args.device, torch.bfloat16, enabled=args.size == "full"):
            loss = call(images, present, *prompt, actions, noise, flow_time, *geometry).mean()
        loss.backward()
        if args.device == "cuda":
            torch.cuda.synchronize()

    return {arm: lambda arm=arm: step(arm) for arm in args.arms or ARMS}


def network_of(arm: str, networks: dict[str, nn.Module]) -> nn.Module:
    return networks["lerobot" if arm.startswith("lerobot") else "ours"]


def used_time() -> float:
    """Seconds of a processor, of this process and of the compilers that it ran."""
    return sum(os.times()[:4])


def against_lerobot(args: argparse.Namespace) -> dict[str, Any]:
    networks = build_networks(args)
    steps = network_steps(args, networks)
    clock = used_time if args.cpu_time else time.perf_counter
    seconds: dict[str, list[float]] = {arm: [] for arm in steps}
    for _ in range(args.rounds + 1):
        for arm, step in steps.items():
            start = clock()
            step()
            seconds[arm].append(clock() - start)
            if len(seconds[arm]) == 1:
                print(f"{arm:22} first step {seconds[arm][0]:.2f} s", flush=True)
    for network in networks.values():
        network.zero_grad()
    result = {}
    reference = "lerobot" if "lerobot" in steps else next(iter(steps))
    for arm, (first, *later) in seconds.items():
        ratios = [a / b for a, b in zip(later, seconds[reference][1:], strict=True)]
        result[arm] = {
            "seconds": statistics.median(later), "time_ratio": statistics.median(ratios),
            "time_ratio_range": [min(ratios), max(ratios)], "first_step_seconds": first,
        }  # fmt: skip
        if args.device == "cuda" or not arm.endswith(COMPILED):  # live tensors are not seen inside compiled code
            result[arm]["peak_MiB"] = peak_memory(network_of(arm, networks), steps[arm])
    for arm, found in result.items():
        if "peak_MiB" in found and "peak_MiB" in result[reference]:
            found["memory_ratio"] = found["peak_MiB"] / result[reference]["peak_MiB"]
        print(f"{arm:22}" + "".join(f"{k} {v:9.3f}  " for k, v in found.items() if isinstance(v, float)))
    return result


# --- the policy: micro-batches and flow samples -----------------------------------------------------------------------


def policy_config(args: argparse.Namespace, **settings: Any) -> PI05GeometryConfig:
    """A policy with as many geometry tokens, of a source that needs no camera."""
    vlm, expert = VARIANTS[args.size]
    size = IMAGE_SIZE[args.size]
    inputs = {
        "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, size, size)),
        "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
    }
    common: dict[str, Any] = {"dtype": "bfloat16" if args.size == "full" else "float32", "push_to_hub": False}
    return PI05GeometryConfig(
        paligemma_variant=vlm, action_expert_variant=expert, device=args.device, image_resolution=(size, size),
        chunk_size=CHUNK, n_action_steps=CHUNK, geometry_source="random", geometry_grid=GRID, input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (8,))}, **common | settings,
    )  # fmt: skip


def build_policy(args: argparse.Namespace, **settings: Any) -> PI05GeometryPolicy:
    torch.manual_seed(0)
    return PI05GeometryPolicy(policy_config(args, **settings)).train()


def policy_batch(args: argparse.Namespace, size: int, seed: int) -> dict[str, Tensor]:
    """Random images; the prompt names two numbers, of which the actions are a smooth function: something to learn."""
    generator = torch.Generator().manual_seed(seed)
    pixels = IMAGE_SIZE[args.size]
    numbers = torch.randint(0, 256, (size, 2), generator=generator)
    tokens = torch.randint(300, 1000, (size, args.prompt), generator=generator)
    tokens[:, :2] = 300 + numbers
    phase = torch.linspace(0, 3, CHUNK)[None, :, None] * (1 + torch.arange(8) / 8)
    first, second = (numbers[:, i, None, None] / 255 for i in range(2))
    batch = {
        "observation.images.front": torch.rand(size, 3, pixels, pixels, generator=generator),
        "observation.state": torch.zeros(size, 8),
        "observation.language.tokens": tokens,
        "observation.language.attention_mask": torch.ones(size, args.prompt, dtype=torch.bool),
        "action": torch.sin(phase + 6 * first) * (0.5 + second),
        "index": torch.arange(size) + 10_000 * seed,
    }
    return {key: value.to(args.device) for key, value in batch.items()}


def micro_batches(args: argparse.Namespace) -> dict[str, Any]:
    """Peaks of a batch of 32 in micro-batches of 4, and of batches of 4 and 32 at once: of forward and backward, and of a
    whole training step with AdamW."""
    result: dict[str, Any] = {}
    for checkpointing in (False, True):
        for optimise in (False, True):
            peaks = {}
            for name, size, micro in (("4", 4, None), ("32 by 4", 32, 4), ("32", 32, None)):
                policy = build_policy(args, micro_batch_size=micro, gradient_checkpointing=checkpointing)
                peaks[name] = step_peak(policy, policy_batch(args, size, 0), optimise)
            kind = ("step" if optimise else "gradients") + (", checkpointing" if checkpointing else "")
            result[kind] = peaks | {"ratio": peaks["32 by 4"] / peaks["4"]}
            print(f"{kind:26}" + "  ".join(f"{k}: {v:7.1f} MiB" for k, v in peaks.items())
                  + f"  32 by 4 over 4: {result[kind]['ratio']:.3f}")  # fmt: skip
    return result


def step_peak(policy: PI05GeometryPolicy, batch: dict[str, Tensor], optimise: bool) -> float:
    """MiB of one step; with the optimiser, of one that is not the first, so that its moments are there."""
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())

    def step() -> None:
        policy.forward(batch)[0].backward()
        if optimise:
            optimizer.step()
            optimizer.zero_grad()

    if optimise:
        step()
    return peak_memory(policy, step, [t for state in optimizer.state.values() for t in state.values()])


@contextmanager
def evaluation(policy: PI05GeometryPolicy) -> Iterator[None]:
    policy.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        policy.train()


def flow_samples(args: argparse.Namespace) -> dict[str, Any]:
    """Held-out loss after the same time of training, per K; and what K costs per step."""
    clock = time.process_time if args.cpu_time else time.perf_counter
    result: dict[str, Any] = {}
    held_out = policy_batch(args, 64, 999)
    for K in (1, 2, 4, 8):
        policy = build_policy(args, flow_samples=K, optimizer_lr=1e-3)
        optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
        trained, step = 0.0, 0
        while trained < args.flow_samples:
            batch = policy_batch(args, args.batch, step + 1)
            start = clock()
            policy.forward(batch)[0].backward()
            optimizer.step()
            optimizer.zero_grad()
            policy.update()
            trained += clock() - start
            step += 1
        policy.config.flow_samples = 1  # the same noise for everyone
        with evaluation(policy):
            loss = policy.forward(held_out)[1]["loss"]
        result[str(K)] = {"held_out_loss": loss, "steps": step, "seconds_per_step": trained / step}
        print(f"K = {K}: {step} steps of {1e3 * trained / step:.0f} ms, held-out loss {loss:.4f}")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=tuple(VARIANTS), default="small")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--cameras", type=int, default=1)
    parser.add_argument("--prompt", type=int, default=100, help="prompt tokens; a state of 14 numbers takes some 70")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--arms", nargs="+", choices=ALL_ARMS, help="against LeRobot's: only these")
    parser.add_argument(
        "--lerobot-compile-mode", default="max-autotune", help="of torch.compile; LeRobot's is the default"
    )
    parser.add_argument("--cpu-time", action="store_true", help="time that the process has used, not that has passed")
    parser.add_argument("--flow-samples", type=float, metavar="SECONDS", help="train so long at K = 1, 2, 4, 8")
    parser.add_argument("--output", help="write the numbers to this JSON file")
    args = parser.parse_args()
    result: dict[str, Any] = {"settings": vars(args) | {"threads": torch.get_num_threads()}}
    if args.flow_samples:
        result["flow_samples"] = flow_samples(args)
    else:
        result["against_lerobot"] = against_lerobot(args)
        if args.size != "mid" and not args.arms:  # a policy is configured by the sizes that it has
            result["micro_batches"] = micro_batches(args)
    if args.output:
        with open(args.output, "w") as file:
            json.dump(result, file, indent=2)


if __name__ == "__main__":
    main()
