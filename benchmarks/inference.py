"""Time of an action chunk: ours with geometry, ours without, LeRobot's π0.5 eager and, if asked, compiled.

    python -m benchmarks.inference --cameras 1 3                 small size, float32
    python -m benchmarks.inference --cameras 1 3 --full          released size, bfloat16, random weights (needs about 20 GB)
    python -m benchmarks.inference --cameras 1 3 --full --device cuda --compiled ours --da3 base --trace traces
    python -m benchmarks.inference --cameras 1 3 --full --device cuda --compiled lerobot

All arms run the same weights and observations in one process, in turn, round by round, each round another first; a ratio is the
median over rounds of an arm's time over eager LeRobot's in the same round. Ours is what a policy uses by default (the runner; on
a GPU as CUDA graphs, with an arm without them beside it), with geometry features given: what measures depth is not in it. `--da3`
adds two arms that also measure: Depth Anything 3 with random weights on the same cameras, beside vision and prefix, and before
them. `--rtc` adds two arms of the runner that continue a previous chunk, guided and trained. Ours pads the prompt (`--prompt`
tokens) to what it needs, on a GPU to the next multiple of 32; LeRobot's always to 200. The
floor is what this machine's own matrix products and memory would need for our network's products alone, measured in the same run.
`far` is the distance of the runner's actions from the plain path's, over the size of those. Memory is the peak of live tensors in
the first chunk; on a CPU the compiled arms cannot be watched.
"""

import argparse
import json
import platform
import statistics
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

from benchmarks.memory import peak_memory
from benchmarks.network import build, fill, inputs
from benchmarks.network import parts as lerobot_parts
from lerobot_policy_pi05_geometry.geometry import GeometryEncoder
from lerobot_policy_pi05_geometry.geometry.da3 import VARIANTS, Da3Backbone, Da3Encoder, Da3Source
from lerobot_policy_pi05_geometry.geometry.da3.encoder import store_products_in
from lerobot_policy_pi05_geometry.inference.cuda_graphs import GraphRunner
from lerobot_policy_pi05_geometry.inference.layers import run_layers
from lerobot_policy_pi05_geometry.inference.runner import ChunkFunctions, ChunkRunner, ChunkSettings, Observation
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.inference.side_stream import PendingGeometry
from lerobot_policy_pi05_geometry.model import PI05Pytorch
from lerobot_policy_pi05_geometry.model.config import RtcMode
from lerobot_policy_pi05_geometry.model.segments import GeometryTokens

EAGER, COMPILED, GEOMETRY, PLAIN = "lerobot", "lerobot compiled", "geometry", "no geometry"
NO_GRAPHS, OWN_COMPILED, BESIDE, BEFORE = "geometry, no graphs", "geometry, compiled", "da3 beside", "da3 before"
GUIDED, TRAINED = "rtc guided", "rtc trained"
PAIRS = {
    "beside over before": (BESIDE, BEFORE),
    "graphs over none": (GEOMETRY, NO_GRAPHS),
    "compiled over not": (OWN_COMPILED, GEOMETRY),
    "rtc guided over none": (GUIDED, GEOMETRY),
    "rtc trained over none": (TRAINED, GEOMETRY),
}


class CompiledWhole(ChunkRunner):
    """A runner whose whole chunk is one compiled function. Policies do not have it: on a CPU it gains little and takes long."""

    def __init__(self, network: PI05Pytorch) -> None:
        super().__init__(network)
        self._whole = torch.compile(self._both, dynamic=False, options={"max_autotune": True, "cpp_wrapper": True})

    def _both(self, observation, early, noise, late, previous, settings):
        return self.denoise(self.prefill(observation, early, settings), noise, late, previous, settings)

    def _functions(self, observation, noise, previous, settings):
        return ChunkFunctions(lambda *seen: seen, lambda seen, *inputs: self._whole(*seen, *inputs, settings))


class CompiledGraphs(GraphRunner):
    """A runner with compiled layers, recorded."""

    def __init__(self, network: PI05Pytorch) -> None:
        super().__init__(network)
        self._compiled = torch.compile(run_layers, dynamic=False, fullgraph=True)

    def _run(self, segment, embs, frame, cache, modulations, output):
        x, layers = embs.to(self.config.dtype), self._layers[segment]
        return self._compiled(x, layers, self.config.expert, frame, cache, cache.span(segment), modulations, output)


def synchronise(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def seconds(run: Callable[[], object], device: str) -> float:
    synchronise(device)
    start = time.perf_counter()
    run()
    synchronise(device)
    return time.perf_counter() - start


def observe(args: argparse.Namespace, cameras: int, tokens: int) -> tuple[Observation, Tensor]:
    """The same observation for everyone, with a prompt padded to `tokens`, and noise, on the device."""
    batch = inputs(argparse.Namespace(**{**vars(args), "cameras": cameras}), tokens)
    images, masks = ([x.to(args.device) for x in batch[name]] for name in ("images", "img_masks"))
    text = batch["tokens"].to(args.device), batch["masks"].to(args.device)
    return Observation(images, masks, *text), batch["noise"].to(args.device)


def geometry_tokens(args: argparse.Namespace, ours: PI05Pytorch) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(1, args.geometry_tokens, ours.geometry_width, generator=generator).to(args.device)


def da3(args: argparse.Namespace, observation: Observation, ours: PI05Pytorch) -> PendingGeometry:
    """Depth Anything 3 on the cameras of an observation, 8 x 8 cells each."""
    backbone = Da3Backbone(VARIANTS[args.da3])
    fill(backbone)
    store_products_in(backbone, torch.bfloat16)
    batch = {f"observation.images.{i}": (image + 1) / 2 for i, image in enumerate(observation.images)}
    source = Da3Source({key: key for key in batch}, 8, Da3Encoder(backbone))
    encoder = GeometryEncoder(source, ours.geometry_width).eval().to(args.device)
    return PendingGeometry(source.num_tokens, partial(encoder, batch))


RTC_ARMS: dict[str, RtcMode] = {GUIDED: "guided", TRAINED: "trained"}
DELAY = 5  # action steps that are executed while a chunk is computed


def continued_chunk(sample: Callable[..., Tensor], tokens: Tensor, ours: PI05Pytorch, mode: RtcMode) -> Tensor:
    """A chunk of the runner that continues a random one, by real-time chunking."""
    left_over = torch.ones(1, ours.config.chunk_size - DELAY, ours.config.max_action_dim, device=tokens.device)
    ours.rtc_processor, ours.rtc_mode = RTCProcessor(RTCConfig()), mode
    actions = sample(geom_embs=tokens, prev_chunk_left_over=left_over, inference_delay=DELAY)
    ours.rtc_processor = None
    return actions


def chunk_functions(
    args: argparse.Namespace, cameras: int, sampler: ChunkSampler, ours: PI05Pytorch, lerobot
) -> dict[str, Callable[[], Tensor]]:
    """A chunk of each arm, from the same observation."""
    (short, noise), (padded, _) = observe(args, cameras, args.prompt), observe(args, cameras, 200)
    # Inductor's own graphs, LeRobot's here, clear workspaces that ours would go on using.
    runner = "eager" if args.device != "cpu" and "lerobot" in args.compiled else "fast"
    sample = partial(sampler, *short, noise=noise, runner=runner)
    tokens = geometry_tokens(args, ours)
    functions: dict[str, Callable[[], Tensor]] = {
        GEOMETRY: lambda: sample(geom_embs=tokens),
        PLAIN: sample,
        EAGER: lambda: lerobot.sample_actions(*padded, noise=noise),
    }
    if args.rtc:
        functions |= {arm: partial(continued_chunk, sample, tokens, ours, mode) for arm, mode in RTC_ARMS.items()}
    if args.device != "cpu" and runner == "fast":
        functions[NO_GRAPHS] = lambda: sample(geom_embs=tokens, runner="eager")
    if args.da3:
        pending = da3(args, short, ours)

        def before() -> Tensor:
            embs, pad = pending.measure()
            return sample(geom_embs=embs, geom_pad=pad)

        functions |= {BESIDE: lambda: sample(geometry=pending), BEFORE: before}
    if "ours" in args.compiled:
        torch._dynamo.config.recompile_limit = 64  # every number of cameras is a shape of its own
        if args.device != "cpu" and runner == "eager":
            raise SystemExit("On a GPU, measure --compiled ours and --compiled lerobot in runs of their own.")
        own_compiled = CompiledWhole(ours) if args.device == "cpu" else CompiledGraphs(ours)
        functions[OWN_COMPILED] = lambda: own_compiled(*short, noise=noise, geom_embs=tokens)
    if "lerobot" in args.compiled:
        compiled = torch.compile(lerobot.sample_actions, mode="max-autotune")  # as LeRobot's compile_model does
        functions[COMPILED] = lambda: compiled(*padded, noise=noise)
    return functions


def far(args: argparse.Namespace, cameras: int, ours: PI05Pytorch) -> float:
    """How far the runner's actions are from the plain path's, over four draws of noise."""
    (observation, noise), tokens = observe(args, cameras, args.prompt), geometry_tokens(args, ours)
    sampler = ChunkSampler(ours)

    def actions(runner: str, seed: int) -> Tensor:
        other = torch.randn(noise.shape, generator=torch.Generator().manual_seed(seed)).to(noise)
        return sampler(*observation, noise=other, geom_embs=tokens, runner=runner)

    fast, plain = (torch.stack([actions(runner, seed) for seed in range(4)]) for runner in ("fast", "plain"))
    return ((fast - plain).norm() / plain.norm()).item()


def split(args: argparse.Namespace, cameras: int, ours: PI05Pytorch, lerobot) -> tuple[dict[str, float], float | None]:
    """Where the runner's time goes without graphs: medians of its parts and all denoising steps, in seconds.

    Then, on a CPU, a denoising step over one of LeRobot's.
    """
    (observation, noise), runner = observe(args, cameras, args.prompt), ChunkRunner(ours)
    embs = geometry_tokens(args, ours)
    geometry = GeometryTokens(embs, torch.ones(embs.shape[:2], dtype=torch.bool, device=embs.device))
    times: dict[str, list[float]] = {"vision and text": [], "prefix": [], "geometry": [], "denoising": []}

    def timed[T](part: str, run: Callable[[], T]) -> T:
        result: list[T] = []
        times[part].append(seconds(lambda: result.append(run()), args.device))
        return result[0]

    steps = ours.config.num_inference_steps
    on_cpu = args.device == "cpu"
    lengths = (args.geometry_tokens, noise.shape[1])
    settings = ChunkSettings(args.geometry_tokens, lengths, steps, 0.0)
    with_cameras = argparse.Namespace(**{**vars(args), "cameras": cameras})
    theirs = lerobot_parts(EAGER, lerobot, with_cameras)["denoise step"] if on_cpu else None
    ratios = []
    for _ in range(args.rounds + 1):
        prefix = timed("vision and text", partial(runner.embed_prefix, observation))
        context = timed("prefix", partial(runner.prefill_prefix, prefix, settings.lengths))
        segment = timed("geometry", partial(runner.prefill_geometry, context, geometry))
        timed("denoising", partial(runner.denoise_suffix, context, noise, segment, None, settings))
        if theirs is not None:
            ratios.append(
                times["denoising"][-1] / steps / statistics.mean(seconds(theirs, args.device) for _ in range(3))
            )
    parts = {part: statistics.median(values[1:]) for part, values in times.items()}
    return parts, statistics.median(ratios[1:]) if ratios else None


def trace(args: argparse.Namespace, cameras: int, functions: dict[str, Callable[[], Tensor]]) -> None:
    """A chunk of each arm as a file for chrome://tracing or Perfetto."""
    args.trace.mkdir(parents=True, exist_ok=True)
    for arm, function in functions.items():
        synchronise(args.device)
        with torch.profiler.profile() as profiler:
            function()
            synchronise(args.device)
        name = arm.replace(",", "").replace(" ", "_")
        profiler.export_chrome_trace(str(args.trace / f"{cameras}_cameras_{name}.json"))


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


def first_chunks(
    args: argparse.Namespace,
    functions: dict[str, Callable[[], Tensor]],
    sampler: ChunkSampler,
    ours: PI05Pytorch,
    lerobot,
) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds of every arm's first chunk, which is compiled or recorded, if so; and the most memory it takes, in MiB."""
    first, memory = {}, {}
    for arm, function in functions.items():
        if args.device == "cpu" and arm in (COMPILED, OWN_COMPILED):
            first[arm] = seconds(function, args.device)
            continue
        network = lerobot if arm in (EAGER, COMPILED) else ours
        start = time.perf_counter()
        kept = sampler.tensors() if arm == PLAIN else []  # by the arm before, which has the same runner
        memory[arm] = peak_memory(network, function, kept)
        first[arm] = time.perf_counter() - start
    return first, memory


def measure(args: argparse.Namespace, cameras: int, ours: PI05Pytorch, lerobot) -> dict:
    """Times of all arms with this many cameras."""
    sampler = ChunkSampler(ours)
    functions = chunk_functions(args, cameras, sampler, ours, lerobot)
    times: dict[str, list[float]] = {arm: [] for arm in functions}
    first, memory = first_chunks(args, functions, sampler, ours, lerobot)
    turn = deque(functions)
    for round_index in range(args.rounds + args.warmup):
        turn.rotate()  # so that none is always first; the order stays the same otherwise
        for arm in turn:
            value = seconds(functions[arm], args.device)
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
            "first_s": first[arm],
        }
        if arm in memory:
            result[arm] |= {"peak_MiB": memory[arm], "memory_ratio": memory[arm] / memory[EAGER]}
    if args.trace:
        trace(args, cameras, functions)
    parts, step = split(args, cameras, ours, lerobot)
    least = floor(args, cameras, ours)
    with_geometry = statistics.median(a / b for a, b in zip(times[GEOMETRY], times[PLAIN], strict=True))
    ratios = {"geometry over no geometry": with_geometry}
    if step is not None:
        ratios["step over LeRobot's"] = step
    for name, (one, other) in PAIRS.items():
        if one in times and other in times:
            ratios[name] = statistics.median(a / b for a, b in zip(times[one], times[other], strict=True))
    return {
        "arms": result,
        **ratios,
        "far": far(args, cameras, ours),
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
        "--compiled",
        choices=("lerobot", "ours"),
        nargs="+",
        default=[],
        help="also LeRobot's with compile_model=True (minutes of compiling; on a GPU ours then runs without graphs), "
        "or the runner's (a minute per number of cameras)",
    )
    parser.add_argument("--chunk", type=int, default=50, help="action steps")
    parser.add_argument("--prompt", type=int, default=100, help="prompt tokens; a state of 14 numbers takes some 70")
    parser.add_argument("--geometry-tokens", type=int, default=64)
    parser.add_argument(
        "--da3", choices=sorted(VARIANTS), help="also measure geometry with Depth Anything 3 of this size"
    )
    parser.add_argument(
        "--rtc", action="store_true", help="also chunks that continue the previous one (real-time chunking)"
    )
    parser.add_argument("--trace", type=Path, help="write a trace of each arm into this folder")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--warmup", type=int, default=1)
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    args = parser.parse_args()

    one = argparse.Namespace(**{**vars(args), "cameras": args.cameras[0]})
    lerobot = build(EAGER, one)
    ours = build(GEOMETRY, one, lerobot).to(args.device)
    lerobot.to(args.device)
    machine = f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    size, theirs = (sum(p.nbytes for p in network.parameters()) for network in (ours, lerobot))
    print(f"weights {size / 2**30:.2f} GiB, {size / theirs:.2f} of LeRobot's")
    summary: dict = {
        "machine": torch.cuda.get_device_name() if args.device != "cpu" else machine,
        "settings": {name: value for name, value in vars(args).items() if name not in ("output", "trace")},
        "weights over LeRobot's": size / theirs,
    }
    for cameras in args.cameras:
        found = measure(args, cameras, ours, lerobot)
        summary[f"{cameras} cameras"] = found
        print(f"{cameras} camera(s)")
        for arm, row in found["arms"].items():
            shown = f"p50 {row['p50_ms']:9.1f} ms   p95 {row['p95_ms']:9.1f} ms   first {row['first_s']:6.1f} s"
            peak = f"   peak {row['peak_MiB']:.0f} MiB   ratio {row['memory_ratio']:.2f}" if "peak_MiB" in row else ""
            print(f"  {arm:20} {shown}   ratio {row['ratio']:.2f}{peak}")
        for name in ("geometry over no geometry", "step over LeRobot's", *PAIRS, "chunk over floor", "far"):
            if name in found:
                print(f"  {name} {found[name]:.3g}")
        for name in ("split_ms", "floor_ms"):
            print(f"  {name:10}" + "   ".join(f"{part} {value:.1f}" for part, value in found[name].items()))
    if args.output:
        args.output.write_text(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main()
