"""The commands on a checkpoint: inspect, bench, convert, export, merge."""

from pathlib import Path
from typing import Annotated

import typer

from .app import Output, app, console


@app.command()
def inspect(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    dataset_root: Annotated[Path, typer.Option("--dataset.root", help="Folder of a LeRobotDataset.")],
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    frame: Annotated[int, typer.Option(help="Index of the frame.")] = 0,
    device: Annotated[str, typer.Option(help="Device of the policy.")] = "cpu",
    output: Output = Path("inspect.html"),
    rerun: Annotated[
        Path | None, typer.Option(help="A file of the scene for the rerun viewer, too (needs rerun-sdk).")
    ] = None,
) -> None:
    """Figures of a checkpoint on a dataset frame: attention mask, depth with grid cells, the scene, attention of the actions."""
    from lerobot_policy_pi05_geometry.inspect.inspection import write_inspection

    write_inspection(checkpoint, dataset_root, dataset_repo_id, frame, device, output, rerun)
    console.print(f"Open [bold]{output}[/bold]")


@app.command()
def bench(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    device: Annotated[str, typer.Option(help="Device of the policy.")] = "cpu",
    dataset_root: Annotated[
        Path | None,
        typer.Option("--dataset.root", help="Use the first frame of this dataset. Default: a random observation."),
    ] = None,
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    rounds: Annotated[int, typer.Option(help="Predictions to time.")] = 20,
) -> None:
    """Latency of an action chunk of a checkpoint on this machine, of its parts and by denoising steps, and advice."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from rich.table import Table

    from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
    from lerobot_policy_pi05_geometry.dataset_folder import require_dataset
    from lerobot_policy_pi05_geometry.inspect.bench import bench as run
    from lerobot_policy_pi05_geometry.inspect.bench import random_observation
    from lerobot_policy_pi05_geometry.inspect.inspection import frame_batch

    if dataset_root is not None:
        require_dataset(dataset_root)
    loaded = load_policy(checkpoint, device)
    if dataset_root is None:
        observation = random_observation(loaded.policy.config)
    else:
        unit = loaded.policy.config.depth_unit
        observation = frame_batch(LeRobotDataset(dataset_repo_id, root=dataset_root, depth_output_unit=unit), 0)
    result = run(loaded, observation, rounds)
    table = Table("", "median ms", "95 % ms")
    rows = {"action chunk": result.chunk, "plain path": result.plain} | {
        f"  {name}": timing for name, timing in result.parts.items()
    }
    rows |= {f"{count} denoising step{'s' * (count > 1)}": timing for count, timing in result.steps.items()}
    for name, timing in rows.items():
        table.add_row(name, f"{timing.p50:.1f}", f"{timing.p95:.1f}")
    console.print(table)
    if result.peak_bytes is not None:
        console.print(f"Peak memory: {result.peak_bytes / 2**30:.2f} GiB")
    for name, state in result.explanation.items():
        console.print(f"{name}: {state}", soft_wrap=True)
    for sentence in result.advice:
        console.print(f"→ {sentence}", soft_wrap=True)


@app.command()
def convert(
    source: Annotated[
        str,
        typer.Argument(help="π0.5 checkpoint of LeRobot or openpi (PyTorch), or one of this policy: folder or hub id."),
    ],
    output: Annotated[Path, typer.Argument(help="Folder to write; it must not be there.")],
    geometry_source: Annotated[
        str | None,
        typer.Option(
            help="rgbd (depth cameras), da3 (RGB cameras), features (da3, precomputed), random (control), none."
        ),
    ] = None,
    da3_encoder: Annotated[
        str | None,
        typer.Option(help="Depth Anything 3, for da3 and features: hub id, folder or file. Default: DA3-BASE."),
    ] = None,
    geometry_cameras: Annotated[
        str | None,
        typer.Option(
            help="Cameras in token order, as front,wrist. Default: the source's, or the one that the data has."
        ),
    ] = None,
    geometry_grid: Annotated[int | None, typer.Option(help="Cells per side and camera.")] = None,
    geometry_frame: Annotated[str | None, typer.Option(help="Points in the robot's base frame, or camera.")] = None,
    geometry_expert: Annotated[str | None, typer.Option(help="shared, or own: a copy of the action expert.")] = None,
    geometry_tokens: Annotated[
        str | None,
        typer.Option(help="statistics; of depth also points (learned pooling); of da3 also rays (camera rays beside)."),
    ] = None,
    geometry_gate_openness: Annotated[
        float | None, typer.Option(help="Of the gate at the start: 1e-7 is shut, 1 open.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file. Default: what the training data carries.")
    ] = None,
    features_from_data: Annotated[
        bool, typer.Option("--features-from-data", help="Cameras and state as the training data names them.")
    ] = False,
    chunk_size: Annotated[
        int | None, typer.Option(help="Actions per chunk, where an openpi source does not say.")
    ] = None,
    tokenizer_path: Annotated[
        str | None, typer.Option(help="Tokenizer folder or hub id. Default: the one the source names.")
    ] = None,
    revision: Annotated[str | None, typer.Option(help="Revision of a hub id.")] = None,
    seed: Annotated[int, typer.Option(help="Another seed draws another geometry adapter.")] = 0,
) -> None:
    """Start from a π0.5: write a checkpoint of this policy that acts as the source does, ready for --policy.path.

    Weights, settings and processor statistics carry over. An openpi checkpoint brings weights only: cameras and
    statistics then come from the data it is trained on. By default: rgbd, 8 cells per side, points in the base frame, the
    gate shut.

    A checkpoint of this policy gets another geometry: only what is named changes, all else stays as it is.
    """
    from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart
    from lerobot_policy_pi05_geometry.checkpoint.conversion import convert as run

    geometry = GeometryStart(
        source=geometry_source,
        cameras=None if geometry_cameras is None else tuple(geometry_cameras.split(",")),
        calibration=calibration,
        grid=geometry_grid,
        frame=geometry_frame,
        expert=geometry_expert,
        openness=geometry_gate_openness,
        encoder=da3_encoder,
        tokens=geometry_tokens,
    )
    run(
        source, output, geometry, features_from_data=features_from_data, chunk_size=chunk_size,
        tokenizer=tokenizer_path, seed=seed, revision=revision,
    )  # fmt: skip
    console.print(f"Train it: lerobot-train --policy.path={output} --dataset.repo_id=you/your_dataset ...")


@app.command()
def export(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id of this policy.")],
    output: Annotated[Path, typer.Argument(help="Folder to write; it must not be there.")],
) -> None:
    """The way back: write a checkpoint as LeRobot's own π0.5 (--policy.type=pi05), without its geometry."""
    from lerobot_policy_pi05_geometry.checkpoint.conversion import export as run

    run(checkpoint, output)
    console.print(f"LeRobot's π0.5 loads it: --policy.path={output}")


@app.command()
def merge(
    checkpoint: Annotated[Path, typer.Argument(help="Folder of a checkpoint that was trained with --peft.")],
    output: Annotated[Path, typer.Argument(help="Folder to write; it must not be there.")],
) -> None:
    """Fold LoRA into the weights: write a checkpoint that acts the same and needs neither PEFT nor its base."""
    from lerobot_policy_pi05_geometry.checkpoint.merge import merge as run

    run(checkpoint, output)
    console.print(f"Wrote [bold]{output}[/bold].")
