"""Training steps with no geometry, depth, random tokens, Depth Anything 3 live, and its features from a store, side by side.

    python -m benchmarks.da3_training               small policy, DA3-BASE with random weights, on the CPU

All arms of a setting run in one process, in turn, round by round; a ratio is the median over rounds of two arms in the same
round, by the clock and in processor time, which other programs on the machine disturb less. A step is loss, backward and
optimiser, on other frames each time. `random` has the store's tokens (their number and width) and measures nothing: what the
store costs beyond it is reading. Memory is the highest resident memory during a step above that before it. The frames of the
store are read for the first time, so they are checked against their checksums; they have just been written, so they come
from the page cache. `cold` reads them from the disk, the page cache emptied before.
"""

import argparse
import ctypes
import gc
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pandas
import torch
from lerobot.configs import FeatureType, PolicyFeature
from safetensors.torch import save_file
from torch import Tensor

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.geometry import CameraCalibration, GeometryEncoder
from lerobot_policy_pi05_geometry.geometry.da3 import (
    BACKBONE_PREFIX,
    VARIANTS,
    Da3Backbone,
    Da3Encoder,
    default_image_size,
)
from lerobot_policy_pi05_geometry.geometry.da3.weights import load_da3
from lerobot_policy_pi05_geometry.geometry.feature_store import FeatureStore, Manifest
from lerobot_policy_pi05_geometry.geometry.feature_store.fingerprint import read_episodes
from lerobot_policy_pi05_geometry.geometry.feature_store.match import STORES
from lerobot_policy_pi05_geometry.geometry.feature_store.shards import writing
from lerobot_policy_pi05_geometry.geometry.random_tokens import RandomSource
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy

ARMS = ("none", "rgbd", "random", "da3", "features")
CAMERAS = ("front", "left", "right")
STATE, ACTION, CHUNK = 8, 7, 16
FRAMES, SHARD_FRAMES = 192, 64


def write_encoder(path: Path, variant: str) -> Path:
    """Random weights under the released names."""
    torch.manual_seed(0)
    backbone = Da3Backbone(VARIANTS[variant])
    for parameter in backbone.parameters():
        torch.nn.init.normal_(parameter, std=0.02 if parameter.ndim > 1 else 1.0)
    save_file({BACKBONE_PREFIX + name: tensor for name, tensor in backbone.state_dict().items()}, path)
    return path


def config(source: str, grid: int, cameras: Sequence[str], encoder: Path, size: int) -> PI05GeometryConfig:
    features = {
        f"observation.images.{camera}": PolicyFeature(FeatureType.VISUAL, (3, size, size)) for camera in cameras
    }
    if source == "rgbd":
        features |= {f"{key}_depth": PolicyFeature(FeatureType.VISUAL, (1, size, size)) for key in list(features)}
    pose = torch.eye(4).tolist()
    calibration = {
        camera: CameraCalibration([size, size, size / 2, size / 2], [size, size], pose) for camera in cameras
    }
    return PI05GeometryConfig(
        device="cpu",
        paligemma_variant="small",
        action_expert_variant="small",
        image_resolution=(84, 84),
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        max_action_dim=ACTION,
        geometry_source=source,
        geometry_grid=grid,
        calibration=calibration if source == "rgbd" else {},
        da3_encoder=str(encoder) if source in ("da3", "features") else None,
        input_features=features | {"observation.state": PolicyFeature(FeatureType.STATE, (STATE,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))},
        push_to_hub=False,
    )


def write_store(root: Path, live: PI05GeometryConfig, feature_dim: int) -> FeatureStore:
    """A store of random features beside a dataset of which only the metadata exist."""
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta" / "info.json").write_text("{}")
    (root / "meta" / "episodes").mkdir(exist_ok=True)
    pandas.DataFrame({"episode_index": [0], "length": [FRAMES]}).to_parquet(root / "meta/episodes/file-000.parquet")
    manifest = Manifest.new(
        read_episodes(root), encoder=str(live.da3_encoder), encoder_hash=str(live.da3_hash),
        image_size=default_image_size(live.geometry_grid), dtype=live.da3_dtype, grid=live.geometry_grid,
        cameras=live.rgb_cameras(), feature_dim=feature_dim, dataset_files={}, shard_frames=SHARD_FRAMES,
    )  # fmt: skip
    folder = root / STORES / manifest.key
    folder.mkdir(parents=True)
    manifest.write(folder)
    for shard in range(manifest.shards):
        with writing(folder, manifest, shard, SHARD_FRAMES) as writer:
            assert writer is not None
            for batch in writer.batches():
                writer.append(torch.randn(len(batch), *manifest.shape))
            writer.finish()
    return FeatureStore(folder)


def build(source: str, grid: int, cameras: Sequence[str], encoder: Da3Encoder, args: argparse.Namespace, root: Path):
    """One arm's policy, in training."""
    torch.manual_seed(0)
    settings = config(source, grid, cameras, args.encoder, args.image)
    meta = SimpleNamespace(root=root) if source == "features" else None
    policy = PI05GeometryPolicy(settings, dataset_meta=meta, encoder=encoder if source == "da3" else None)
    if source == "random":  # the tokens of the store, in number and width
        random = RandomSource(tuple(sorted(cameras)), grid, encoder.variant.feature_dim)
        policy.geometry = GeometryEncoder(random, policy.model.geometry_width)
    return policy.train()


class Arm:
    """A policy with its optimiser, and the steps it is asked for."""

    def __init__(self, policy: PI05GeometryPolicy) -> None:
        self.policy = policy
        self.optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())

    def step(self, batch: dict[str, Tensor]) -> None:
        loss, _ = self.policy.forward(batch)
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.policy.update()


def make_batch(cameras: Sequence[str], args: argparse.Namespace, indices: Tensor) -> dict[str, Tensor]:
    size, shape = len(indices), (args.image, args.image)
    batch = {f"observation.images.{camera}": torch.rand(size, 3, *shape) for camera in cameras}
    batch |= {f"observation.images.{camera}_depth": 300 + 1000 * torch.rand(size, 1, *shape) for camera in cameras}
    return batch | {
        "observation.state": torch.rand(size, STATE),
        "observation.language.tokens": torch.randint(0, 1024, (size, 32)),
        "observation.language.attention_mask": torch.ones(size, 32, dtype=torch.bool),
        "action": torch.randn(size, CHUNK, ACTION),
        "index": indices,
    }


def status(name: str) -> float:
    """A figure of this process's memory in MB (Linux)."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1e3 for line in file if line.startswith(name))


def peak_of(arm: Arm, batch: dict[str, Tensor]) -> float:
    """MB of resident memory that a step takes above what is resident before it."""
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # forget the highest resident memory so far
    before = status("VmRSS")
    arm.step(batch)
    return status("VmHWM") - before


def read_times(folder: Path, batch: int) -> dict[str, float]:
    """Milliseconds to read a batch of shuffled frames: from the disk, checked, and again."""
    for path in folder.glob("*.bin"):
        with path.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    store, order = FeatureStore(folder), torch.randperm(FRAMES).split(batch)
    times: dict[str, list[float]] = {"cold": [], "checked": [], "again": []}

    def measure(name: str, store: FeatureStore) -> None:
        for indices in order[:12]:
            start = time.perf_counter()
            store.read(indices.tolist())
            times[name].append(1e3 * (time.perf_counter() - start))

    measure("cold", store)
    measure("again", store)
    measure("checked", FeatureStore(folder))
    return {name: statistics.median(found) for name, found in times.items()}


def measure(grid: int, cameras: Sequence[str], encoder: Da3Encoder, args: argparse.Namespace, root: Path) -> dict:
    """One setting: samples/s, ratios and memory of every arm."""
    live = config("da3", grid, cameras, args.encoder, args.image)
    live.da3_hash = args.hash
    live.validate_features()
    store = write_store(root, live, encoder.variant.feature_dim)
    arms = {source: Arm(build(source, grid, cameras, encoder, args, root)) for source in ARMS}
    order = torch.randperm(FRAMES)
    batches = [make_batch(cameras, args, indices) for indices in order.split(args.batch)]
    seconds: dict[str, list[float]] = {arm: [] for arm in ARMS}
    processor: dict[str, list[float]] = {arm: [] for arm in ARMS}
    for round_index in range(args.rounds + 1):
        for name, arm in arms.items():
            steps = 1 if name == "da3" else args.repeat
            start, busy = time.perf_counter(), time.process_time()
            for i in range(steps):
                arm.step(batches[(round_index * args.repeat + i) % len(batches)])
            if round_index:  # the first round warms up
                seconds[name].append((time.perf_counter() - start) / steps)
                processor[name].append((time.process_time() - busy) / steps)
    peaks = {name: peak_of(arm, batches[-1]) for name, arm in arms.items()}
    rows = {
        name: {
            "samples_per_s": args.batch / statistics.median(found),
            "cpu_s": statistics.median(processor[name]),
            "ms_added": 1e3 * statistics.median(a - b for a, b in zip(found, seconds["none"], strict=True)),
            "peak_MB": peaks[name],
            "MB_added": peaks[name] - peaks["none"],
        }
        for name, found in seconds.items()
    }
    folder, frame_bytes = store.folder, store.manifest.record_bytes
    del arms, arm, store
    gc.collect()  # pages that are mapped do not leave the page cache

    def ratio(times: dict[str, list[float]], over: str) -> float:
        return statistics.median(b / a for a, b in zip(times["features"], times[over], strict=True))

    return {
        "grid": grid,
        "cameras": len(cameras),
        "arms": rows,
        "store_over_live": {"clock": ratio(seconds, "da3"), "CPU": ratio(processor, "da3")},
        "store_over_random": {"clock": ratio(seconds, "random"), "CPU": ratio(processor, "random")},
        "read_ms": read_times(folder, args.batch),
        "frame_kB": frame_bytes / 1e3,
    }


def show(result: dict) -> None:
    print(
        f"\n{result['grid']} x {result['grid']}, {result['cameras']} camera(s), {result['frame_kB']:.0f} kB per frame"
    )
    print(f"{'':10}{'samples/s':>12}{'CPU s':>12}{'ms added':>12}{'peak MB':>12}{'MB added':>12}")
    for name, row in result["arms"].items():
        print(f"{name:10}" + "".join(f"{value:12.2f}" for value in row.values()))
    for name in ("store_over_live", "store_over_random"):
        print(f"{name.replace('_', ' ')}: " + ", ".join(f"{value:.2f} x by {by}" for by, value in result[name].items()))
    print("reading a batch, ms: " + ", ".join(f"{name} {value:.2f}" for name, value in result["read_ms"].items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="base", choices=sorted(VARIANTS), help="Depth Anything 3's size")
    parser.add_argument("--grids", type=int, nargs="+", default=[8, 14])
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 3])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--image", type=int, default=224, help="pixels per side of a camera's image")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--repeat", type=int, default=4, help="steps per round of every arm but da3, which makes one")
    parser.add_argument("--output", help="write the numbers to this JSON file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        args.encoder = write_encoder(Path(folder) / "model.safetensors", args.variant)
        settings = config("da3", args.grids[0], CAMERAS[:1], args.encoder, args.image)
        encoder = load_da3(settings)
        args.hash = encoder.content_hash
        results = []
        for grid in args.grids:
            for count in args.cameras:
                with tempfile.TemporaryDirectory() as dataset:
                    results.append(measure(grid, CAMERAS[:count], encoder, args, Path(dataset)))
                show(results[-1])
        size = sum(tensor.nbytes for tensor in encoder.state_dict().values()) / 1e6
    print(f"\nThe encoder itself takes {size:.0f} MB where it is live, and nothing with a store.")
    machine = f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    if args.output:
        written = {k: v for k, v in vars(args).items() if k not in ("encoder", "hash", "output")}
        summary = {"machine": machine, "settings": written, "encoder_MB": size, "results": results}
        Path(args.output).write_text(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main()
