"""The `pi05-geometry` command."""

import logging
import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

os.environ.setdefault("TQDM_DISABLE", "1")  # LeRobot's bars would draw over ours
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

if TYPE_CHECKING:
    from .study.launch import Progress as StudyProgress
    from .study.runs import Run

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)
console = Console()

Output = Annotated[Path, typer.Option(help="Folder for everything this writes.")]
Task = Annotated[
    str,
    typer.Option(
        help="Simulated task: button-press-topdown-wide, faucet-open-wide, coffee-button-wide, or any Meta-World v3 name."
    ),
]
Cameras = Annotated[str, typer.Option(help="Range of camera poses: fixed, train, outside, far or wide.")]
Sensor = Annotated[str, typer.Option(help="Depth sensor: ideal, noisy, off, calibration-1, -2 or -5.")]


def _bars() -> Progress:
    return Progress(
        TextColumn("{task.description:<48}"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _require_simulator() -> None:
    from .sim.configuration import require_simulator

    require_simulator()


Workers = Annotated[int | None, typer.Option(help="Runs at once; one per core if left out.")]


@app.command()
def demo(
    output: Output = Path("demo"),
    workers: Workers = None,
) -> None:
    """Record a simulated RGB-D task, train with and without geometry, evaluate both and a blind floor, write a report.

    Everything happens on this machine's CPU. An interrupted demo goes on where it stopped when it is started again. The
    report is report.html in the output folder.
    """
    start = time.monotonic()
    path = _simulated_study("demo", output, workers, retry_crashed=True, command="pi05-geometry demo")
    console.print(f"Done in {(time.monotonic() - start) / 60:.1f} minutes. Open [bold]{path}[/bold]")


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def study(
    context: typer.Context,
    spec: Annotated[
        str, typer.Option(help="A study's TOML file, or one that comes along: default, demo, smoke.")
    ] = "default",
    output: Output = Path("study"),
    workers: Workers = None,
    smoke: Annotated[bool, typer.Option("--smoke", help="Every step at the smallest size: --spec smoke.")] = False,
    retry_crashed: Annotated[bool, typer.Option("--retry-crashed", help="Try runs again that crashed before.")] = False,
    dataset_root: Annotated[
        Path | None, typer.Option("--dataset.root", help="Your own LeRobotDataset instead of the simulator.")
    ] = None,
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    arms: Annotated[str, typer.Option(help="Own data: arms, with commas.")] = "blind,rgb,random,geometry",
    seeds: Annotated[str, typer.Option(help="Own data: training seeds, with commas.")] = "0,1,2",
    steps: Annotated[int, typer.Option(help="Own data: training steps of every run.")] = 3000,
    held_out: Annotated[float, typer.Option(help="Own data: share of the episodes to evaluate on.")] = 0.2,
    frames: Annotated[int, typer.Option(help="Own data: frames to evaluate of each held-out episode.")] = 20,
) -> None:
    """Does geometry help? Train and evaluate every arm of a study, and write its report.

    A study is tasks x arms x training seeds x conditions. Killed and started again it goes on where it stopped; finished
    runs are kept by what they depend on. Over several machines that share the output folder: start it with torchrun on
    each (`torchrun --nnodes 2 --nproc-per-node 4 --no-python pi05-geometry study --workers 1 ...`).

    With --dataset.root it runs on your own data: trained on most episodes, its action error measured on the others. All
    further options go to lerobot-train (`--policy.dtype=bfloat16 --policy.device=cuda --batch_size=8`).
    """
    if dataset_root is None:
        if context.args:
            raise ValueError(f"{context.args[0]} is no option of a simulated study; put the budget into a --spec file.")
        name = "smoke" if smoke else spec
        command = f"pi05-geometry study --spec {name} --output {output}"
        path = _simulated_study(name, output, workers, retry_crashed, command)
    else:
        from .study.held_out import held_out_runs
        from .study.held_out_report import write_held_out_report

        options = _forwarded(context.args)
        numbers = [int(seed) for seed in seeds.split(",")]
        runs = held_out_runs(
            output, dataset_root, dataset_repo_id, arms.split(","), numbers, options, steps, held_out, frames
        )
        if workers is None and options.get("policy.device", "cpu") != "cpu":
            workers = 1  # one run at a time on an accelerator
        _carry_out(runs, workers, retry_crashed)
        command = " ".join(["pi05-geometry study", f"--dataset.root={dataset_root}", *context.args])
        path = write_held_out_report(output, runs, command) if _complete(runs) else None
    if path is not None:
        console.print(f"Open [bold]{path}[/bold]")


def _forwarded(arguments: list[str]) -> dict[str, str]:
    """Options for lerobot-train, as name and value."""
    options = {}
    for argument in arguments:
        name, separator, value = argument.removeprefix("--").partition("=")
        if not argument.startswith("--") or not separator:
            raise ValueError(f"Options for lerobot-train are written --name=value, got '{argument}'.")
        options[name] = value
    return options


def _simulated_study(name: str, output: Path, workers: int | None, retry_crashed: bool, command: str) -> Path | None:
    """Carry out this process's share of a simulated study; write the report if nothing is left to do."""
    _require_simulator()
    from .study.report import write_report
    from .study.simulated import runs_of
    from .study.spec import read_spec

    runs = runs_of(read_spec(name), output)
    _carry_out(runs, workers, retry_crashed)
    return write_report(output, runs, command) if _complete(runs) else None


def _carry_out(runs: "Sequence[Run]", workers: int | None, retry_crashed: bool) -> None:
    from .study.launch import default_workers, launch, share

    with _bars() as bars:
        launch(share(runs), workers or default_workers(), _study_progress(bars), retry_crashed)


def _complete(runs: "Sequence[Run]") -> bool:
    """Whether nothing is left to do; says which runs crashed."""
    crashed = [run for run in runs if run.crash.exists()]
    for run in crashed:
        console.print(f"[bold red]Crashed[/bold red] {run.name}: see {escape(str(run.log))}", soft_wrap=True)
    if any(run.missing() for run in runs if run not in crashed):
        console.print("This process's runs are done; the one that finishes last writes the report.")
        return False
    return True


def _study_progress(bars: Progress) -> "Callable[[StudyProgress], None]":
    """A bar for the whole study, and one for each run under way."""
    whole = bars.add_task("all runs", total=None)
    shown: dict[str, TaskID] = {}

    def update(progress: "StudyProgress") -> None:
        bars.update(whole, completed=progress.done, total=progress.total)
        under_way = {job.run.name: job for job in progress.jobs}
        for name in set(shown) - set(under_way):
            bars.remove_task(shown.pop(name))
        for name, job in under_way.items():
            if name not in shown:
                shown[name] = bars.add_task(name, total=None)
            bars.update(shown[name], description=f"{name}: {job.stage}", completed=job.done, total=job.total or None)

    return update


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
    from .study.frames_in_memory import train_in_memory

    sys.argv = ["lerobot-train", *context.args]  # LeRobot parses the command line itself
    train_in_memory()


@app.command()
def evaluate(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    task: Task = "button-press-topdown-wide",
    cameras: Cameras = "train",
    sensor: Sensor = "ideal",
    episodes: Annotated[int, typer.Option(help="Episodes to run.")] = 50,
    first_seed: Annotated[int, typer.Option(help="Seed of the first episode; the others follow.")] = 0,
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

    environment = MetaworldRgbdEnv(task=task, cameras=cameras, sensor=sensor, image_size=image_size)
    loaded = load_policy(checkpoint, device, environment)
    with _bars() as bars:
        bar = bars.add_task(f"{task}, {cameras}", total=episodes)
        result = run(loaded, environment, episodes, first_seed, progress=lambda done: bars.update(bar, completed=done))
    low, high = result.interval()
    console.print(f"{result.rate:.0%} of {episodes} episodes succeed (95 % interval {low:.0%} to {high:.0%}).")
    if output is not None:
        output.write_text(json.dumps(result.to_json(), indent=2))


@app.command()
def quantiles(
    dataset_root: Annotated[Path, typer.Option("--dataset.root", help="Folder of a LeRobotDataset.")],
) -> None:
    """Recompute a dataset's state and action quantiles over all frames (LeRobot averages those of single episodes)."""
    from .quantiles import write_frame_quantiles

    for key, shares in write_frame_quantiles(dataset_root).items():
        told = " -> ".join(" ".join(f"{share:.0%}" for share in row) for row in shares)
        console.print(f"{key}: q01 to q99 covers of min to max, per dimension: {told}")


@app.command()
def precompute(
    dataset_root: Annotated[
        Path | None, typer.Option("--dataset.root", help="Folder of a LeRobotDataset; the hub's copy if left out.")
    ] = None,
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    encoder: Annotated[
        str, typer.Option(help="Depth Anything 3: hub id, folder or safetensors file.")
    ] = "depth-anything/DA3-BASE",
    grid: Annotated[int, typer.Option(help="Cells per side and camera: the policy's geometry_grid.")] = 8,
    cameras: Annotated[
        str | None, typer.Option(help="With commas, in token order; every RGB camera, sorted, if left out.")
    ] = None,
    image_size: Annotated[int | None, typer.Option(help="Pixels per side: the policy's da3_image_size.")] = None,
    dtype: Annotated[str, typer.Option(help="What the encoder computes in: bfloat16 or float32.")] = "bfloat16",
    batch_size: Annotated[int, typer.Option(help="Frames per pass of the encoder.")] = 16,
    device: Annotated[str | None, typer.Option(help="Where the encoder runs; a GPU if there is one.")] = None,
    output: Annotated[Path | None, typer.Option(help="Folder for stores; the dataset's own if left out.")] = None,
    shard_frames: Annotated[int, typer.Option(help="Frames per file.")] = 512,
    check: Annotated[
        bool, typer.Option("--verify", help="Read the finished store, and compare its checksums.")
    ] = False,
) -> None:
    """Compute geometry from RGB once: Depth Anything 3's features of every frame, to train with geometry_source=features.

    Killed and started again it goes on where it stopped. Several processes or machines that share the folder divide the work
    when started with torchrun (`torchrun --nproc-per-node 4 --no-python pi05-geometry precompute ...`).
    """
    from .precompute.command import run_precompute

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
def merge(
    checkpoint: Annotated[Path, typer.Argument(help="Folder of a checkpoint that was trained with --peft.")],
    output: Annotated[Path, typer.Argument(help="Folder to write; it must not be there.")],
) -> None:
    """Fold LoRA into the weights: write a checkpoint that acts the same and needs neither PEFT nor its base."""
    from .merging import merge as run

    run(checkpoint, output)
    console.print(f"Wrote [bold]{output}[/bold].")


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


@app.command()
def bench(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    device: Annotated[str, typer.Option(help="Where the policy runs.")] = "cpu",
    dataset_root: Annotated[
        Path | None, typer.Option("--dataset.root", help="Take the observation from this dataset; else it is random.")
    ] = None,
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    rounds: Annotated[int, typer.Option(help="Predictions to time.")] = 20,
) -> None:
    """How long a checkpoint takes for an action chunk on this machine, where the time goes, and what would change it."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from rich.table import Table

    from .bench import bench as run
    from .bench import random_observation
    from .inspect.inspection import frame_batch
    from .loading import load_policy

    loaded = load_policy(checkpoint, device)
    if dataset_root is None:
        observation = random_observation(loaded.policy.config)
    else:
        unit = loaded.policy.config.depth_unit
        observation = frame_batch(LeRobotDataset(dataset_repo_id, root=dataset_root, depth_output_unit=unit), 0)
    result = run(loaded, observation, rounds)
    table = Table("", "median ms", "95 % ms")
    rows = {"action chunk": result.chunk, "by the plain path": result.plain} | {
        f"  {name}": timing for name, timing in result.parts.items()
    }
    for name, timing in rows.items():
        table.add_row(name, f"{timing.p50:.1f}", f"{timing.p95:.1f}")
    console.print(table)
    if result.peak_bytes is not None:
        console.print(f"Peak memory: {result.peak_bytes / 2**30:.2f} GiB")
    for name, state in result.explanation.items():
        console.print(f"{name}: {state}", soft_wrap=True)
    for sentence in result.advice:
        console.print(f"→ {sentence}", soft_wrap=True)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def plan(
    context: typer.Context,
    gpu: Annotated[
        str | None, typer.Option(help="Propose what fits it: its memory in GB (24), or a card (h100).")
    ] = None,
    batch_size: Annotated[int, typer.Option("--batch_size", help="Samples per training step.", min=1)] = 8,
    micro_batch_size: Annotated[
        int, typer.Option(help="Samples whose activations are held at once; 0 for the whole batch.", min=0)
    ] = 0,
    optimizer: Annotated[
        str | None, typer.Option(help="adamw or adamw8bit. Default: adamw, or whichever fits.")
    ] = None,
    lora: Annotated[str | None, typer.Option(help="LoRA adapters on the expert, or on all (VLM and expert).")] = None,
    lora_rank: Annotated[int, typer.Option(help="Rank of the adapters.", min=1)] = 16,
    cameras: Annotated[int, typer.Option(help="RGB cameras, where no checkpoint names them.", min=0)] = 2,
    depth_cameras: Annotated[int, typer.Option(help="Of them with depth, for geometry_source=rgbd.", min=1)] = 1,
    image_size: Annotated[str, typer.Option(help="Height x width in which images arrive.")] = "480x640",
    prompt_tokens: Annotated[
        int | None, typer.Option(help="Tokens of the longest prompt. Default: tokenizer_max_length.", min=1)
    ] = None,
    proposals: Annotated[int, typer.Option(help="How many proposals to make.", min=1)] = 3,
    explain: Annotated[
        bool, typer.Option("--explain", help="Say what was assumed, and why other settings do not fit.")
    ] = False,
) -> None:
    """Will it fit? Predict peak memory of training and inference, without a GPU and without allocating it.

    Settings are given as to lerobot-train: `pi05-geometry plan --policy.dtype=bfloat16 --batch_size=8`, or
    `--policy.path=CHECKPOINT` for its own.

    With --gpu, propose settings that fit, best first: the closest to full fine-tuning (full; all but the vision tower, each with
    AdamW before 8-bit AdamW; LoRA on VLM and expert; the action expert only; LoRA on the expert), and of each the largest
    number of samples at once. What you give stays as it is. Exit code 1 if nothing fits.
    """
    from .planner.command import Data, Wish, run

    sizes = image_size.lower().split("x")
    if len(sizes) != 2 or not all(side.isdecimal() and int(side) > 0 for side in sizes):
        raise ValueError(f"--image-size is height x width in pixels, as 480x640; got '{image_size}'.")
    data = Data(cameras, depth_cameras, (int(sizes[0]), int(sizes[1])), prompt_tokens)
    wish = Wish(gpu, batch_size, micro_batch_size or None, optimizer, lora, lora_rank, proposals, explain)
    for shown in run(context.args, data, wish):
        console.print(shown)


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
