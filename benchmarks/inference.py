"""Time and memory of an action chunk: ours with geometry, ours without, LeRobot's π0.5 eager and, if asked, compiled.

    python -m benchmarks.inference --cameras 1 3                 small size, float32
    python -m benchmarks.inference --cameras 1 3 --full          released size, bfloat16, random weights (needs about 20 GB)
    python -m benchmarks.inference --full --device cuda --compiled

All arms run the same weights and observations in one process, in turn, round by round; a ratio is the median over rounds of
an arm's time over eager LeRobot's in the same round. Ours is what a policy uses by default (the runner), with geometry features
given: what measures them (depth, or Depth Anything 3) is not in it. Ours pads the prompt (`--prompt` tokens) to what it needs,
LeRobot's always to 200. The floor is what this machine's own matrix products and memory would need for our network's
products alone, measured in the same run.
"""

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.network import build, inputs
from lerobot_policy_pi05_geometry.model import PI05Pytorch, Segment
from lerobot_policy_pi05_geometry.model.runner import ChunkRunner

EAGER, COMPILED, GEOMETRY, PLAIN = "lerobot", "lerobot compiled", "geometry", "no geometry"


def synchronise(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def seconds(run: Callable[[], object], device: str) -> float:
    synchronise(device)
    start = time.perf_counter()
    run()
    synchronise(device)
    return time.perf_counter() - start


def chunk_functions(
    args: argparse.Namespace, cameras: int, ours: PI05Pytorch, lerobot
) -> dict[str, Callable[[], Tensor]]:
    """A chunk of each arm, from the same observation."""
    settings = argparse.Namespace(**{**vars(args), "cameras": cameras})

    def observation(tokens: int) -> tuple[tuple, Tensor]:
        batch = inputs(settings, tokens)
        noise = batch.pop("noise").to(args.device)
        moved = ([x.to(args.device) for x in batch[name]] for name in ("images", "img_masks"))
        return (*moved, batch["tokens"].to(args.device), batch["masks"].to(args.device)), noise

    (short, noise), (padded, _) = observation(args.prompt), observation(200)
    runner = ChunkRunner(ours)
    tokens = torch.randn(1, args.geometry_tokens, ours.geometry_width, generator=torch.Generator().manual_seed(2))
    tokens = tokens.to(args.device)
    functions = {
        GEOMETRY: lambda: runner(*short, noise=noise, geom_embs=tokens),
        PLAIN: lambda: runner(*short, noise=noise),
        EAGER: lambda: lerobot.sample_actions(*padded, noise=noise),
    }
    if args.compiled:
        compiled = torch.compile(lerobot.sample_actions, mode="max-autotune")  # as LeRobot's compile_model does
        functions[COMPILED] = lambda: compiled(*padded, noise=noise)
    return functions


def split(args: argparse.Namespace, cameras: int, ours: PI05Pytorch) -> dict[str, float]:
    """Where the runner's time goes: medians of vision and text, prefix, geometry, and all denoising steps, in seconds."""
    settings = argparse.Namespace(**{**vars(args), "cameras": cameras})
    batch, runner = inputs(settings, args.prompt), ChunkRunner(ours)
    noise = batch.pop("noise").to(args.device)
    observation = [[x.to(args.device) for x in batch[name]] for name in ("images", "img_masks")]
    observation += [batch["tokens"].to(args.device), batch["masks"].to(args.device)]
    embs = torch.zeros(1, args.geometry_tokens, ours.geometry_width, device=args.device)
    times: dict[str, list[float]] = {"vision and text": [], "prefix": [], "geometry": [], "denoising": []}
    for _ in range(args.rounds + 1):
        prepared: list = []
        times["vision and text"].append(
            seconds(lambda into=prepared: into.append(runner.prepare(*observation, noise, embs, None)), args.device)
        )
        segments, frames, cache = prepared[0]
        times["prefix"].append(
            seconds(lambda a=(Segment.PREFIX, segments, frames, cache): runner.prefill(*a), args.device)
        )
        times["geometry"].append(
            seconds(lambda a=(Segment.GEOMETRY, segments, frames, cache): runner.prefill(*a), args.device)
        )
        steps = ours.config.num_inference_steps
        times["denoising"].append(seconds(lambda a=(noise, steps, frames, cache): runner.denoise(*a), args.device))
    return {part: statistics.median(values[1:]) for part, values in times.items()}


def floor(args: argparse.Namespace, cameras: int, ours: PI05Pytorch) -> dict[str, float]:
    """Seconds that the network's matrix products need at this machine's own rates: arithmetic, or reading the weights."""
    dtype, device = ours.config.dtype, args.device
    side = 2048 if args.full else 512
    a, b = torch.randn(side, side, device=device).to(dtype), torch.randn(side, side, device=device).to(dtype)
    rate = 2 * side**3 / min(seconds(lambda: a @ b, device) for _ in range(10))
    network = ours.paligemma_with_expert
    patches = (ours.config.image_size // ours.config.paligemma.vision.patch_size) ** 2

    def need(module: torch.nn.Module, tokens: int) -> float:
        numbers = sum(p.numel() for p in module.parameters() if p.ndim > 1)
        # As large as the weights, since what fits a cache is read faster; but of no more than 1 GB in bfloat16.
        block = torch.ones(min(numbers, 2**29), device=device, dtype=dtype)
        copying = min(seconds(block.clone, device) for _ in range(5)) * numbers / block.numel()
        return max(2 * numbers * tokens / rate, copying / 2)  # a copy reads and writes

    steps, expert = ours.config.num_inference_steps, network.expert.layers
    return {
        "vision": need(network.paligemma.model.vision_tower, cameras * patches),
        "prefix": need(network.language_model.layers, cameras * patches + args.prompt),
        "geometry": need(expert, args.geometry_tokens),
        "denoising": steps * need(expert, args.chunk),
    }


def measure(args: argparse.Namespace, cameras: int, ours: PI05Pytorch, lerobot) -> dict:
    """Times of all arms with this many cameras."""
    functions = chunk_functions(args, cameras, ours, lerobot)
    times: dict[str, list[float]] = {arm: [] for arm in functions}
    for round_index in range(args.rounds + args.warmup):
        for arm, function in functions.items():
            value = seconds(function, args.device)
            if round_index >= args.warmup:
                times[arm].append(value)
    result = {}
    for arm, values in times.items():
        ratios = [mine / theirs for mine, theirs in zip(values, times[EAGER], strict=True)]
        ordered = sorted(values)
        result[arm] = {
            "p50_ms": 1e3 * statistics.median(values),
            "p95_ms": 1e3 * ordered[min(len(ordered) - 1, round(0.95 * len(ordered)))],
            "ratio": statistics.median(ratios),
        }
    parts, least = split(args, cameras, ours), floor(args, cameras, ours)
    with_geometry = statistics.median(a / b for a, b in zip(times[GEOMETRY], times[PLAIN], strict=True))
    return {
        "arms": result,
        "geometry over no geometry": with_geometry,
        "split_ms": {part: 1e3 * value for part, value in parts.items()},
        "floor_ms": {part: 1e3 * value for part, value in least.items()},
        "chunk over floor": result[GEOMETRY]["p50_ms"] / (1e3 * sum(least.values())),
    }


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="released size in bfloat16")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cameras", type=int, nargs="+", default=[1])
    parser.add_argument(
        "--compiled", action="store_true", help="LeRobot's compile_model=True too (minutes of compiling)"
    )
    parser.add_argument("--chunk", type=int, default=50, help="action steps")
    parser.add_argument("--prompt", type=int, default=100, help="prompt tokens; a state of 14 numbers takes some 70")
    parser.add_argument("--geometry-tokens", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--warmup", type=int, default=1)
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    args = parser.parse_args()

    one = argparse.Namespace(**{**vars(args), "cameras": args.cameras[0]})
    lerobot = build(EAGER, one)
    ours = build(GEOMETRY, one, lerobot).to(args.device)
    lerobot.to(args.device)
    machine = f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    summary: dict = {
        "machine": torch.cuda.get_device_name() if args.device != "cpu" else machine,
        "settings": {name: value for name, value in vars(args).items() if name != "output"},
    }
    for cameras in args.cameras:
        found = measure(args, cameras, ours, lerobot)
        summary[f"{cameras} cameras"] = found
        print(f"{cameras} camera(s)")
        for arm, row in found["arms"].items():
            print(f"  {arm:18} p50 {row['p50_ms']:9.1f} ms   p95 {row['p95_ms']:9.1f} ms   ratio {row['ratio']:.2f}")
        print(f"  geometry costs {found['geometry over no geometry']:.3f} of ours without")
        for name in ("split_ms", "floor_ms"):
            print(f"  {name:10}" + "   ".join(f"{part} {value:.1f}" for part, value in found[name].items()))
        print(f"  chunk over floor {found['chunk over floor']:.2f}")
    if args.output:
        args.output.write_text(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main()
