"""The command around the computation: device, share of this process, messages, progress bar."""

import os
import time
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from rich.markup import escape
from rich.progress import Progress

from ..dataset_folder import require_dataset
from .run import Precompute, begin, disk_needed, free_bytes, prepare, verify


def run_precompute(
    root: Path | None,
    repo_id: str,
    encoder: str,
    grid: int,
    cameras: list[str] | None,
    image_size: int | None,
    dtype: str,
    batch_size: int,
    device: str | None,
    output: Path | None,
    shard_frames: int,
    check: bool,
    bars: Progress,
) -> None:
    """Compute this process's share of a store, under torchrun or alone. The parameters are the command's options."""
    if root is not None:
        require_dataset(root)
    rank, world_size = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    dataset = LeRobotDataset(repo_id, root=root, return_uint8=True)
    work = prepare(dataset, encoder, grid, cameras, image_size, dtype, output, shard_frames)
    if rank == 0:
        _announce(work, bars)
    begin(work)
    _compute(work, batch_size, _device(device), rank, world_size, bars)
    if work.missing():
        bars.console.print(
            "This process's files are done; the store is finished when those of the other processes are "
            f"({len(work.missing())} of {work.manifest.shards} files are missing)."
        )
        return
    if check and rank == 0:
        bar = bars.add_task("verify", total=work.manifest.frames * work.manifest.record_bytes, rate="")
        for size in verify(work.folder):
            bars.advance(bar, size)
    if rank == 0:
        bars.console.print(
            f"Train on it: lerobot-train --policy.type=pi05_geometry --policy.geometry_source=features "
            f"--policy.geometry_grid={grid} --policy.features_path={escape(str(work.folder))} ...",
            soft_wrap=True,
        )


def _announce(work: Precompute, bars: Progress) -> None:
    views, cells, width = work.manifest.shape
    whole = work.manifest.frames * work.manifest.record_bytes
    bars.console.print(
        f"{work.manifest.frames} frames x {views} camera(s) x {cells} cells x {width} features: {whole / 1e9:.2f} GB in "
        f"{escape(str(work.folder))} ({disk_needed(work) / 1e9:.2f} GB still to write, {free_bytes(work.folder) / 1e9:.1f} GB "
        "free).",
        soft_wrap=True,
    )


def _compute(
    work: Precompute, batch_size: int, device: torch.device, rank: int, world_size: int, bars: Progress
) -> None:
    mine = work.missing(rank, world_size)
    total = sum(len(work.manifest.frames_of(shard)) for shard in mine)
    bar = bars.add_task("features" if world_size == 1 else f"features, rank {rank}", total=total, rate="")
    start, computed = time.monotonic(), 0

    def update(frames: int, found: bool) -> None:
        nonlocal computed
        computed += 0 if found else frames
        rate = computed / max(time.monotonic() - start, 1e-3)
        bars.update(bar, advance=frames, rate=f"{rate:.1f} frames/s" if computed else "")

    work.run(batch_size, device, rank, world_size, update)


def _device(name: str | None) -> torch.device:
    """The device of this process; with several GPUs, each rank of a machine uses its own."""
    if name is None:
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda":
        name = f"cuda:{int(os.environ.get('LOCAL_RANK', '0')) % max(1, torch.cuda.device_count())}"
    return torch.device(name)
