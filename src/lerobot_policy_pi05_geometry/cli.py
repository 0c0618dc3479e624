"""The `pi05-geometry` command."""

import logging
import os
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

os.environ.setdefault("TQDM_DISABLE", "1")  # LeRobot's bars would draw over ours
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)
console = Console()

Output = Annotated[Path, typer.Option(help="Folder for everything this writes.")]
Task = Annotated[
    str, typer.Option(help="Simulated task: button-press-topdown-wide, faucet-open-wide, or any Meta-World v3 name.")
]
Cameras = Annotated[str, typer.Option(help="Range of camera poses: fixed, train, outside, far or wide.")]


def _bars() -> Progress:
    return Progress(
        TextColumn("{task.description:<28}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _require_simulator() -> None:
    from .sim.configuration import require_simulator

    require_simulator()


@app.command()
def demo(
    output: Output = Path("demo"),
    minimal: Annotated[bool, typer.Option(help="Every step at the smallest size, to see that it works.")] = False,
) -> None:
    """Record a simulated RGB-D task, train with and without geometry, evaluate both, and write a report.

    Everything happens on this machine's CPU, in some 15 to 20 minutes on two cores. An interrupted demo goes on where it
    stopped when it is started again. The report is report.html in the output folder.
    """
    _require_simulator()
    from .demo.report import write_report
    from .demo.run import DemoSettings, run_demo

    settings = DemoSettings()
    if minimal:
        settings = DemoSettings(
            variant="tiny", episodes=2, steps=4, blind_steps=2, batch_size=4, image_size=28, evaluation_episodes=2,
            parallel=2, videos=1,
        )  # fmt: skip
    start = time.monotonic()
    with _bars() as bars:
        tasks: dict[str, TaskID] = {}

        def progress(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=total)
            bars.update(tasks[name], completed=done)

        results = run_demo(output, settings, progress)
    path = write_report(output, settings, results)
    console.print(f"Done in {(time.monotonic() - start) / 60:.1f} minutes. Open [bold]{path}[/bold]")


@app.command()
def record(
    output: Output,
    task: Task = "button-press-topdown-wide",
    episodes: Annotated[int, typer.Option(help="Successful expert episodes to record.")] = 100,
    cameras: Cameras = "train",
    image_size: Annotated[int, typer.Option(help="Pixels per side of RGB and depth.")] = 84,
    seed: Annotated[int, typer.Option(help="Another seed records other episodes.")] = 0,
) -> None:
    """Record scripted experts into a LeRobotDataset v3 with native depth and calibration."""
    _require_simulator()
    from .sim.record import record as record_episodes

    with _bars() as bars:
        bar = bars.add_task("record expert episodes", total=episodes)
        for done, _ in record_episodes(output, f"local/{output.name}", task, episodes, cameras, image_size, seed=seed):
            bars.update(bar, completed=done)
    console.print(
        f"Train on it: lerobot-train --policy.type=pi05_geometry --dataset.repo_id=local/{output.name} "
        f"--dataset.root={output} ..."
    )


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})
def train(context: typer.Context) -> None:
    """lerobot-train with decoded frames kept in memory; takes its arguments. For datasets that fit."""
    from .demo.frames_in_memory import train_in_memory

    sys.argv = ["lerobot-train", *context.args]  # LeRobot parses the command line itself
    train_in_memory()


@app.command()
def evaluate(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    task: Task = "button-press-topdown-wide",
    cameras: Cameras = "train",
    episodes: Annotated[int, typer.Option(help="Episodes, on seeds 0, 1, ...")] = 50,
    image_size: Annotated[int, typer.Option(help="Pixels per side; as in training.")] = 84,
    device: Annotated[str, typer.Option(help="Where the policy runs.")] = "cpu",
    output: Annotated[Path | None, typer.Option(help="Write the outcome of every episode to this JSON file.")] = None,
) -> None:
    """Success rate of a checkpoint on a simulated task, with its 95 % interval."""
    import json

    _require_simulator()
    from .loading import load_policy
    from .sim.configuration import MetaworldRgbdEnv
    from .sim.evaluate import evaluate as run

    environment = MetaworldRgbdEnv(task=task, cameras=cameras, image_size=image_size)
    loaded = load_policy(checkpoint, device, environment)
    with _bars() as bars:
        bar = bars.add_task(f"{task}, {cameras}", total=episodes)
        result = run(loaded, environment, episodes, progress=lambda done: bars.update(bar, completed=done))
    low, high = result.interval()
    console.print(f"{result.rate:.0%} of {episodes} episodes succeed (95 % interval {low:.0%} to {high:.0%}).")
    if output is not None:
        output.write_text(json.dumps(result.to_json(), indent=2))


@app.command()
def inspect(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    dataset_root: Annotated[Path, typer.Option("--dataset.root", help="Folder of a LeRobotDataset.")],
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    frame: Annotated[int, typer.Option(help="Which frame of the dataset to look at.")] = 0,
    device: Annotated[str, typer.Option(help="Where the policy runs.")] = "cpu",
    output: Output = Path("inspect.html"),
) -> None:
    """Pictures of a checkpoint on a frame of a dataset: attention layout, depth with grid cells, where actions look."""
    from .inspect.inspection import write_inspection

    write_inspection(checkpoint, dataset_root, dataset_repo_id, frame, device, output)
    console.print(f"Open [bold]{output}[/bold]")


@app.command()
def convert(
    source: Annotated[str, typer.Argument(help="π0.5 checkpoint of LeRobot or openpi (PyTorch): folder or hub id.")],
    output: Annotated[Path, typer.Argument(help="Folder to write; it must not be there.")],
    geometry_source: Annotated[str, typer.Option(help="rgbd, random (control) or none.")] = "rgbd",
    geometry_cameras: Annotated[
        str | None,
        typer.Option(help="Depth cameras in token order, as front,wrist. Default: the one that the data has."),
    ] = None,
    geometry_grid: Annotated[int, typer.Option(help="Cells per side and camera.")] = 8,
    geometry_frame: Annotated[str, typer.Option(help="Points in the robot's base frame, or camera.")] = "base",
    geometry_expert: Annotated[str, typer.Option(help="shared, or own: a copy of the action expert.")] = "shared",
    geometry_gate: Annotated[float, typer.Option(help="Log-gate to start with; -16 is closed, 0 open.")] = -16.0,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file. Default: the training data's meta/calibration.json.")
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
    statistics then come from the data it is trained on.
    """
    from .conversion import GeometryStart
    from .conversion import convert as run

    geometry = GeometryStart(
        source=geometry_source,
        cameras=None if geometry_cameras is None else tuple(geometry_cameras.split(",")),
        calibration=calibration,
        grid=geometry_grid,
        frame=geometry_frame,
        expert=geometry_expert,
        gate=geometry_gate,
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
    from .conversion import export as run

    run(checkpoint, output)
    console.print(f"LeRobot's π0.5 loads it: --policy.path={output}")


def main() -> None:
    """Entry point: errors of the user's input are one sentence, not a traceback."""
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    for noisy in ("lerobot.utils.import_utils", "datasets", "httpx"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="metaworld")
    warnings.filterwarnings("ignore", module="gymnasium")
    try:
        app()
    except (ValueError, FileNotFoundError, FileExistsError, ModuleNotFoundError, RuntimeError, OSError) as error:
        if os.environ.get("PI05_GEOMETRY_TRACEBACK"):
            raise
        console.print(f"[bold red]Error[/bold red] {escape(str(error))}", soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
