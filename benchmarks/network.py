"""Prefix, denoising step and whole chunk: ours with geometry, ours without, and LeRobot's π0.5, side by side.

    python -m benchmarks.network                    small size, float32
    python -m benchmarks.network --full             released size, bfloat16, random weights (needs about 20 GB)

All three run the same weights and inputs in one process, in turn, round by round; a ratio is the median over rounds of
ours / LeRobot's in the same round. Peak memory is that of a process that builds one of them and predicts one chunk.
Ours pads prompts to what the batch needs (`--prompt` tokens), LeRobot's always to 200: `--prompt 200` takes that apart.
"chunk" is the plain path, "fast chunk" the runner, which policies use by default; LeRobot's is the same in both columns.
"geometry" is what the segment adds to the prefix: prefix and geometry together, minus prefix, of the same round.
"""

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.lerobot_pi05 import build_lerobot_pi05, copy_weights
from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, NetworkConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.precision import Float32Module, compute_in
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS

ARMS = ("geometry", "no geometry", "lerobot")
PARTS = ("prefix", "geometry", "denoise step", "chunk", "fast chunk")


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def uninitialised() -> Iterator[None]:
    """Build modules without drawing their weights, which takes minutes at the released size; `fill` sets them."""
    names = [name for name in dir(torch.nn.init) if name.endswith("_") and not name.startswith("_")]
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(patch.object(torch.nn.init, name, lambda tensor, *_, **__: tensor))
        yield


@torch.no_grad()
def fill(network: torch.nn.Module) -> None:
    """Random weights, quickly: large tensors repeat a random block."""
    drawn = 0.02 * torch.randn(1 << 20, generator=torch.Generator().manual_seed(0), device="cpu")
    for parameter in network.parameters():
        block = drawn.to(parameter)
        flat = parameter.view(-1)
        for start in range(0, len(flat), len(block)):
            flat[start : start + len(block)] = block[: len(flat) - start]


def build(arm: str, args: argparse.Namespace, weights: torch.nn.Module | None = None):
    """One arm's network; `weights` is LeRobot's, to copy from."""
    vlm, expert = ("gemma_2b", "gemma_300m") if args.full else ("small", "small")
    size, dtype = (224, torch.bfloat16) if args.full else (84, torch.float32)
    device = getattr(args, "device", "cpu")  # where the weights are drawn: at the released size, a CPU takes minutes
    if arm == "lerobot":
        with default_dtype(dtype), uninitialised(), torch.device(device):
            network = build_lerobot_pi05(
                vlm, expert, image_size=size, chunk_size=args.chunk, max_action_dim=32,
                dtype="bfloat16" if args.full else "float32",
            )  # fmt: skip
        for module in (network.action_in_proj, network.action_out_proj, network.time_mlp_in, network.time_mlp_out):
            module.float()  # as LeRobot has them; they were built in the default dtype
        fill(network)
        return network.eval()
    config = NetworkConfig(
        PALIGEMMA_VARIANTS[vlm], EXPERT_VARIANTS[expert], size, args.chunk, 32, dtype=dtype, param_dtype=dtype,
        geometry=GeometrySegmentConfig(), rtc_training_max_delay=args.chunk - 1,
    )  # fmt: skip
    with default_dtype(dtype), uninitialised(), torch.device(device):
        network = PI05Pytorch(config)
    for module in network.modules():  # what is stored in float32 was built in the default dtype
        if isinstance(module, Float32Module | torch.nn.LayerNorm):
            module.float()
    fill(network)
    if weights is not None:
        copy_weights(weights, network)
    return network.eval()


def inputs(args: argparse.Namespace, tokens: int) -> dict:
    """The same observation for everyone; LeRobot's has more padding."""
    generator = torch.Generator().manual_seed(1)
    size = 224 if args.full else 84
    text = torch.zeros(1, tokens, dtype=torch.long)
    text[:, : args.prompt] = torch.randint(3, 1000, (1, args.prompt), generator=generator)
    mask = torch.arange(tokens)[None] < args.prompt
    return {
        "images": [torch.rand(1, 3, size, size, generator=generator) * 2 - 1 for _ in range(args.cameras)],
        "img_masks": [torch.ones(1, dtype=torch.bool)] * args.cameras,
        "tokens": text,
        "masks": mask,
        "noise": torch.randn(1, args.chunk, 32, generator=generator),
    }


def parts(arm: str, network, args: argparse.Namespace) -> dict[str, Callable[[], Tensor]]:
    """What is timed, as functions without arguments."""
    batch = inputs(args, 200 if arm == "lerobot" else args.prompt)
    noise = batch.pop("noise")
    observation = (batch["images"], batch["img_masks"], batch["tokens"], batch["masks"])
    now = torch.full((1,), 0.5)
    if arm == "lerobot":

        def prefix():
            from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

            embs, pad, att = network.embed_prefix(*observation)
            mask = prepare_attention_masks_4d(make_att_2d_masks(pad, att))
            network.paligemma_with_expert.paligemma.model.language_model.config._attn_implementation = "eager"
            _, cache = network.paligemma_with_expert.forward(
                attention_mask=mask,
                position_ids=torch.cumsum(pad, dim=1) - 1,
                inputs_embeds=[embs, None],
                use_cache=True,
            )
            return pad, cache

        pad, cache = prefix()
        return {
            "prefix": prefix,
            "denoise step": lambda: network.denoise_step(pad, cache, noise, now),
            "chunk": lambda: network.sample_actions(*observation, noise=noise),
            "fast chunk": lambda: network.sample_actions(*observation, noise=noise),
        }
    tokens, runner = None, ChunkRunner(network)
    if arm == "geometry":
        tokens = torch.randn(
            1, args.geometry_tokens, network.geometry_width, generator=torch.Generator().manual_seed(2)
        )

    def context():
        with compute_in(network.config.dtype, noise.device):
            before, geometry = network._context(*observation, tokens, None, None)
            return before, geometry, network._prefill(before, geometry, args.chunk)

    before, geometry, cache = context()
    return {
        "prefix": context,
        "denoise step": lambda: network.denoise_step(before.pad, cache, noise, now, geometry),
        "chunk": lambda: network.sample_actions(*observation, noise=noise, geom_embs=tokens),
        "fast chunk": lambda: runner(*observation, noise=noise, geom_embs=tokens),
    }


@torch.no_grad()
def times(args: argparse.Namespace) -> dict[str, dict[str, list[float]]]:
    """Seconds per arm, part and round."""
    lerobot = build("lerobot", args)
    ours = build("geometry", args, lerobot)
    functions = {arm: parts(arm, lerobot if arm == "lerobot" else ours, args) for arm in ARMS}
    result: dict[str, dict[str, list[float]]] = {arm: {part: [] for part in PARTS} for arm in ARMS}
    for round_index in range(args.rounds + 1):
        for part in functions["lerobot"]:
            for arm in ARMS:
                start = time.perf_counter()
                for _ in range(args.repeat if "chunk" not in part else 1):
                    functions[arm][part]()
                seconds = (time.perf_counter() - start) / (args.repeat if "chunk" not in part else 1)
                if round_index:  # the first round warms up
                    result[arm][part].append(seconds)
    both, alone = result["geometry"]["prefix"], result["no geometry"]["prefix"]
    result["geometry"]["geometry"] = [a - b for a, b in zip(both, alone, strict=True)]
    result["geometry"]["prefix"] = alone
    return result


@torch.no_grad()
def peak_memory(arm: str, args: argparse.Namespace) -> float:
    """GiB that this process needs above what it held before, for building one arm and one chunk."""
    before = high_water_mark()
    parts(arm, build(arm, args), args)["fast chunk"]()
    return high_water_mark() - before


def high_water_mark() -> float:
    """Largest resident set of this process so far, GiB (Linux; unlike ru_maxrss it does not inherit the parent's)."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 2**20 for line in file if line.startswith("VmHWM"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="released size in bfloat16")
    parser.add_argument("--cameras", type=int, default=1)
    parser.add_argument("--chunk", type=int, default=50, help="action steps")
    parser.add_argument("--prompt", type=int, default=100, help="prompt tokens; a state of 14 numbers takes some 70")
    parser.add_argument("--geometry-tokens", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--repeat", type=int, default=3, help="prefixes and steps per round")
    parser.add_argument("--output", help="write the numbers to this JSON file")
    parser.add_argument("--memory-of", choices=ARMS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.memory_of:
        print(json.dumps(peak_memory(args.memory_of, args)))
        return

    measured = times(args)
    memory = {}
    for arm in ARMS:
        command = [sys.executable, "-m", "benchmarks.network", *sys.argv[1:], "--memory-of", arm]
        memory[arm] = json.loads(
            subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
        )

    print(f"{'':14}" + "".join(f"{part + ' ms':>16}{'ratio':>8}" for part in PARTS) + f"{'peak GiB':>12}{'ratio':>8}")
    summary: dict = {"machine": f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"}
    summary["settings"] = {k: v for k, v in vars(args).items() if k not in ("memory_of", "output")}
    for arm in ARMS:
        row, line = {}, f"{arm:14}"
        for part in PARTS:
            values, peer = measured[arm][part], measured["lerobot"][part]
            milliseconds = 1e3 * statistics.median(values) if values else None
            ratio = statistics.median(a / b for a, b in zip(values, peer, strict=True)) if values and peer else None
            row[part] = {"ms": milliseconds, "ratio": ratio}
            line += f"{'-' if milliseconds is None else f'{milliseconds:.1f}':>16}{'-' if ratio is None else f'{ratio:.2f}':>8}"
        row["peak"] = {"GiB": memory[arm], "ratio": memory[arm] / memory["lerobot"]}
        print(line + f"{memory[arm]:12.2f}{row['peak']['ratio']:8.2f}")
        summary[arm] = row
    if args.output:
        with open(args.output, "w") as file:
            json.dump(summary, file, indent=2)


if __name__ == "__main__":
    main()
