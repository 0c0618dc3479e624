"""From disk to loss: samples per second of an RGB-D dataset with two cameras of 480 x 640 in video, and where the time goes.

    python -m benchmarks.data_path                      small network, batches of 8, with 0, 2 and 4 workers
    python -m benchmarks.data_path --network mid        a wider one: what is fixed per sample becomes a smaller part

The dataset is written by LeRobot's own recorder into a temporary folder: RGB and depth as video, in LeRobot's default codecs, of
synthetic scenes (a tilted plane, a moving box, noise, holes). Reading it is LeRobot's data loader as in lerobot-train, then the
processors and the loss. Parts are in seconds of a processor per sample, each measured by itself on the same samples, so they
hold on a machine that others use too; samples per second are of time that passed.
"""

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy, make_pre_post_processors
from torch.utils.data import DataLoader

import benchmarks.training_step  # noqa: F401 (adds the size mid)
from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.data.images import ImageRangeCheck, prepare_images
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.depth import check_measured, check_unit, to_metres
from lerobot_policy_pi05_geometry.geometry.point_map import placed_points
from lerobot_policy_pi05_geometry.geometry.rgbd import RgbdSource, cell_statistics

HEIGHT, WIDTH, FPS, STATE_DIM, CHUNK = 480, 640, 30, 8, 50
CAMERAS = ("front", "wrist")
REPO_ID = "local/rgbd"
IMAGE_SIZE = {"small": 84, "mid": 112}


# --- the dataset ------------------------------------------------------------------------------------------------------


def write_dataset(root: Path, episodes: int, frames: int) -> None:
    axes = ["height", "width", "channels"]
    features: dict[str, dict] = {
        "observation.state": {"dtype": "float32", "shape": (STATE_DIM,), "names": None},
        "action": {"dtype": "float32", "shape": (STATE_DIM,), "names": None},
    }
    for camera in CAMERAS:
        key = f"observation.images.{camera}"
        features[key] = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": axes}
        features[f"{key}_depth"] = {
            "dtype": "video", "shape": (HEIGHT, WIDTH, 1), "names": axes, "info": {"is_depth_map": True},
        }  # fmt: skip
    dataset = LeRobotDataset.create(REPO_ID, fps=FPS, features=features, root=root, use_videos=True)
    random = np.random.default_rng(0)
    for _ in range(episodes):
        for frame in range(frames):
            images = {}
            for number, camera in enumerate(CAMERAS):
                rgb, depth = scene(frame / frames, number, random)
                images |= {f"observation.images.{camera}": rgb, f"observation.images.{camera}_depth": depth}
            state = np.sin(frame / 9 + np.arange(STATE_DIM)).astype(np.float32)
            dataset.add_frame({**images, "observation.state": state, "action": state, "task": "push the box"})
        dataset.save_episode()
    dataset.finalize()


def scene(moment: float, camera: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """RGB (H, W, 3) uint8 and depth (H, W, 1) uint16 millimetres: a tilted plane, a box that moves, noise, holes."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    depth = 900.0 + 0.6 * v + 80 * camera
    left = int(80 + 320 * moment)
    box = (slice(180, 300), slice(left, left + 120))
    depth[box] -= 150
    rgb = np.stack([u * 0.3 + 40, v * 0.3 + 60, (u + v) * 0.15 + 30], axis=-1)
    rgb[box] = (180, 60, 40)
    rgb += random.normal(0, 3, rgb.shape)
    depth += random.normal(0, 2, depth.shape)
    depth[random.random(depth.shape) < 0.02] = 0
    return rgb.clip(0, 255).astype(np.uint8), depth.clip(0, 65535).astype(np.uint16)[..., None]


# --- measuring --------------------------------------------------------------------------------------------------------


def per_sample(run: Callable[[], object], samples: int, rounds: int) -> float:
    """Median milliseconds of a processor for each of `samples`."""
    run()
    times = []
    for _ in range(rounds):
        start = used()
        run()
        times.append(used() - start)
    return 1e3 * statistics.median(times) / samples


def used() -> float:
    return time.process_time()


def reading(dataset: LeRobotDataset, indices: list[int], rounds: int) -> dict[str, float]:
    """Milliseconds per sample of decoding RGB, of decoding depth, and of the rest of a sample."""
    reader, meta = dataset.reader, dataset.meta
    rows = [dataset.hf_dataset[i] for i in indices]

    def decode(keys: list[str]) -> None:
        for row in rows:
            for key in keys:  # one by one: several at once are decoded in threads
                reader._query_videos({key: [row["timestamp"].item()]}, row["episode_index"].item())

    colour = [key for key in meta.video_keys if key not in meta.depth_keys]
    found = {
        "decoding RGB": per_sample(lambda: decode(colour), len(rows), rounds),
        "decoding depth": per_sample(lambda: decode(list(meta.depth_keys)), len(rows), rounds),
    }
    whole = per_sample(lambda: [dataset[i] for i in indices], len(rows), rounds)
    return found | {"table and action chunk": max(0.0, whole - sum(found.values()))}


def computing(policy: Any, preprocess: Any, raw: dict[str, Any], rounds: int) -> dict[str, float]:
    """Milliseconds per sample of what turns a collated batch into a loss, and of the backward pass."""
    policy.progress.step.fill_(1)  # a step in which no attention is measured
    batch = preprocess(dict(raw))
    size, device = len(batch["action"]), policy.training_step.device
    source = policy.geometry.source
    assert isinstance(source, RgbdSource)

    def each(run: Callable[[str, Any], Any]) -> dict[str, Any]:
        return {camera: run(f"observation.images.{camera}_depth", camera) for camera in CAMERAS}

    def metres(key: str, camera: str) -> Any:
        bounds = source.bounds.get(camera, (0.0, float("inf")))
        return to_metres(batch[key], key, source.unit, (HEIGHT, WIDTH), source.max_depth, 1.0, bounds)

    def checks(key: str, camera: str) -> None:
        check_unit(batch[key], key, source.unit, 1.0, source.bounds.get(camera, (0.0, float("inf"))))
        check_measured(batch[key], key)

    def points(_: str, camera: str) -> Any:
        placed = source.placed[camera]
        return placed_points(depth[camera][0], placed.intrinsics(None, device), placed.poses(batch, None, device))

    with torch.no_grad():
        depth = each(metres)
        maps = each(points)
        parts = {
            "processors (prompt, normaliser)": lambda: preprocess(dict(raw)),
            "check of the image range (first batch only)": lambda: ImageRangeCheck()(batch, policy.config),
            "images to SigLIP's size": lambda: prepare_images(batch, policy.config, device),
            "depth to metres": lambda: each(metres),
            "checks of depth": lambda: each(checks),
            "point maps": lambda: each(points),
            "cells": lambda: each(lambda _, camera: cell_statistics(maps[camera], depth[camera][1], source.grid)),
            "geometry, whole source": lambda: source(batch),
        }
        found = {name: per_sample(run, size, rounds) for name, run in parts.items()}

    def loss() -> Any:
        policy.zero_grad()
        return policy.forward(batch)[0]

    forward = per_sample(loss, size, rounds)
    both = per_sample(lambda: loss().backward(), size, rounds)
    inputs = found["images to SigLIP's size"] + found["geometry, whole source"]
    return found | {"network, forward": forward - inputs, "network, backward": both - forward}


def throughput(
    dataset: LeRobotDataset, workers: int, batch: int, batches: int, step: Callable[[Any], Any]
) -> dict[str, float]:
    """Samples per second from disk to loss; the first batches, which start the workers, are not counted."""
    loader = DataLoader(
        dataset, batch_size=batch, shuffle=True, num_workers=workers, drop_last=True, persistent_workers=workers > 0,
        prefetch_factor=4 if workers else None, generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    source = endless(loader)
    for _ in range(2):
        step(next(source))
    start = time.perf_counter()
    for _ in range(batches):
        step(next(source))
    seconds = (time.perf_counter() - start) / (batches * batch)
    return {"samples_per_second": 1 / seconds}


def endless(loader: DataLoader) -> Iterator[Any]:
    while True:
        yield from loader


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=tuple(IMAGE_SIZE), default="small")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--batches", type=int, default=8, help="to time, for each number of workers")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2, 4])
    parser.add_argument("--rounds", type=int, default=5, help="of each part")
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--frames", type=int, default=60, help="of an episode")
    parser.add_argument("--output", help="write the numbers to this JSON file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name) / "dataset"
        write_dataset(root, args.episodes, args.frames)
        size = IMAGE_SIZE[args.network]
        pose = [[0.0, -1.0, 0.0, 0.4], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.9], [0.0, 0.0, 0.0, 1.0]]
        config = PI05GeometryConfig(
            paligemma_variant=args.network, action_expert_variant=args.network, image_resolution=(size, size), device="cpu",
            chunk_size=CHUNK, push_to_hub=False,
            calibration=dict.fromkeys(CAMERAS, CameraCalibration([600.0, 600.0, 319.5, 239.5], [WIDTH, HEIGHT], pose)),
        )  # fmt: skip
        meta = LeRobotDatasetMetadata(REPO_ID, root=root)
        dataset = LeRobotDataset(REPO_ID, root=root, delta_timestamps=resolve_delta_timestamps(config, meta))
        policy = make_policy(config, dataset.meta).train()
        preprocess, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
        result: dict[str, Any] = {"settings": vars(args) | {"threads": torch.get_num_threads()}}
        steps = {
            "read only": lambda batch: None,
            "to the loss": lambda batch: policy.forward(preprocess(batch))[0],
        }
        for workers in args.workers:
            for title, step in steps.items():
                found = throughput(dataset, workers, args.batch, args.batches, step)
                result.setdefault("throughput", {})[f"{workers} workers, {title}"] = found
                print(
                    f"{workers} workers, {title:12} {found['samples_per_second']:7.1f} samples per second", flush=True
                )
        indices = list(range(3, len(dataset), max(1, len(dataset) // args.batch)))[: args.batch]
        raw = torch.utils.data.default_collate([dataset[i] for i in indices])
        result["parts"] = reading(dataset, indices, args.rounds) | computing(policy, preprocess, raw, args.rounds)
        for part, milliseconds in result["parts"].items():
            print(f"{part:46} {milliseconds:8.2f} ms per sample")
    if args.output:
        Path(args.output).write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
