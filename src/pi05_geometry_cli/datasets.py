"""The commands on a dataset: quantiles, store-calibration, merge-rigs, precompute."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .app import app, console


@app.command()
def quantiles(
    dataset_root: Annotated[Path, typer.Option("--dataset.root", help="Folder of a LeRobotDataset.")],
    actions: Annotated[
        bool, typer.Option("--actions", help="The actions too, as absolute ones, and not the state alone.")
    ] = False,
    full_range: Annotated[
        list[str] | None,
        typer.Option(help="<feature>:<dimension>, such as action:6: its quantiles become its minimum and maximum."),
    ] = None,
) -> None:
    """Recompute a dataset's state quantiles over all frames (LeRobot averages those of single episodes)."""
    from lerobot_policy_pi05_geometry.data.quantiles import write_frame_quantiles

    wanted: dict[str, list[int]] = {}
    for given in full_range or []:
        key, _, dim = given.rpartition(":")
        if not key or not dim.isdigit():
            raise ValueError(f"--full-range needs <feature>:<dimension>, such as action:6, but got '{given}'.")
        wanted.setdefault(key, []).append(int(dim))
    keys = ("observation.state", "action") if actions else ("observation.state",)
    for key, shares in write_frame_quantiles(dataset_root, keys=keys, full_range=wanted).items():
        text = " -> ".join(" ".join(f"{share:.0%}" for share in row) for row in shares)
        console.print(f"{key}: q01 to q99 covers of min to max, per dimension: {text}")


@app.command()
def store_calibration(
    calibration: Annotated[Path, typer.Argument(help="Calibration file (JSON).")],
    dataset_root: Annotated[Path, typer.Option("--dataset.root", help="Folder of a LeRobotDataset.")],
) -> None:
    """Store the calibration of cameras and arms in a dataset's meta/info.json, which LeRobot's editing tools keep."""
    from lerobot_policy_pi05_geometry.geometry.calibration import read_calibration_file
    from lerobot_policy_pi05_geometry.geometry.dataset_calibration import write_dataset_calibration

    found = read_calibration_file(calibration)
    write_dataset_calibration(dataset_root, found)
    console.print(
        f"Stored the calibration of {', '.join(found.cameras) or 'several rigs'} in {dataset_root / 'meta' / 'info.json'}."
    )


@app.command()
def merge_rigs(
    datasets: Annotated[list[Path], typer.Argument(help="Folders of LeRobotDatasets, each with its calibration.")],
    output: Annotated[Path, typer.Option(help="Folder of the merged dataset.")],
    repo_id: Annotated[str, typer.Option(help="Its id.")] = "local/merged",
) -> None:
    """Merge datasets of several robots with LeRobot's tool, so that every frame keeps its own robot's calibration."""
    from lerobot_policy_pi05_geometry.robot.merge_rigs import merge_rigs as merge

    for root, number in merge(datasets, output, repo_id).items():
        console.print(f"{root}: rig {number}")
    console.print(f"Wrote [bold]{output}[/bold]; act on one of these robots with --policy.rig=NUMBER.")


@app.command()
def precompute(
    dataset_root: Annotated[
        Path | None, typer.Option("--dataset.root", help="Folder of a LeRobotDataset; the hub's copy if left out.")
    ] = None,
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    encoder: Annotated[
        str, typer.Option(help="Depth Anything 3: hub id, folder or safetensors file.")
    ] = "depth-anything/DA3-BASE",
    grid: Annotated[int, typer.Option(help="Cells per side and camera: the policy's geometry_grid.", min=1)] = 8,
    cameras: Annotated[
        str | None, typer.Option(help="Comma-separated, in token order. Default: every RGB camera, sorted.")
    ] = None,
    image_size: Annotated[int | None, typer.Option(help="Pixels per side: the policy's da3_image_size.", min=1)] = None,
    dtype: Annotated[str, typer.Option(help="Compute dtype of the encoder: bfloat16 or float32.")] = "bfloat16",
    batch_size: Annotated[int, typer.Option(help="Frames per pass of the encoder.", min=1)] = 16,
    device: Annotated[str | None, typer.Option(help="Device of the encoder. Default: a GPU if available.")] = None,
    output: Annotated[Path | None, typer.Option(help="Folder of the stores. Default: in the dataset's folder.")] = None,
    shard_frames: Annotated[int, typer.Option(help="Frames per file.", min=1)] = 512,
    check: Annotated[bool, typer.Option("--verify", help="Verify the checksums of a finished store.")] = False,
) -> None:
    """Compute Depth Anything 3's features of every frame once, for training with geometry_source=features.

    Started again after an interruption, it continues. Several processes or machines that share the folder divide the frames
    when started with torchrun (`torchrun --nproc-per-node 4 --no-python pi05-geometry precompute ...`).
    """
    from lerobot_policy_pi05_geometry.precompute.command import run_precompute

    names = None if cameras is None else cameras.split(",")
    with Progress(
        TextColumn("{task.description:<28}"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    ) as bars:
        run_precompute(
            dataset_root, dataset_repo_id, encoder, grid, names, image_size, dtype, batch_size, device, output,
            shard_frames, check, bars,
        )  # fmt: skip
