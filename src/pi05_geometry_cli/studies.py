"""The commands that train and compare policies: demo, study."""

import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID

from .app import Output, app, console, progress_bars

if TYPE_CHECKING:
    from lerobot_policy_pi05_geometry.study.launch import Progress as StudyProgress
    from lerobot_policy_pi05_geometry.study.runs import Run

Workers = Annotated[int | None, typer.Option(help="Runs at once. Default: one per core.", min=1)]


@app.command()
def demo(
    output: Output = Path("demo"),
    workers: Workers = None,
) -> None:
    """Train a small π0.5, convert it, fine-tune it with geometry and without, move the camera, switch depth off, report.

    It runs on the CPU. Started again after an interruption, it continues. The report is report.html in the output folder.
    """
    start = time.monotonic()
    path = _simulated_study("demo", output, workers, retry_crashed=True, command="pi05-geometry demo")
    console.print(f"Done in {(time.monotonic() - start) / 60:.1f} minutes. Open [bold]{path}[/bold]")


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def study(
    context: typer.Context,
    spec: Annotated[
        str,
        typer.Option(
            help="A study's TOML file, or the name of one: warm-start, warm-start-short, warm-start-after-rgb, "
            "warm-start-longer, few-steps, default, longer, augmentation, libero, libero-front, libero-pilot, demo, smoke."
        ),
    ] = "default",
    output: Output = Path("study"),
    workers: Workers = None,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Only estimate the core-hours that are left, from a short measurement.")
    ] = False,
    smoke: Annotated[bool, typer.Option("--smoke", help="Every step at the smallest size, as a test.")] = False,
    retry_crashed: Annotated[bool, typer.Option("--retry-crashed", help="Try crashed runs again.")] = False,
    dataset_root: Annotated[
        Path | None, typer.Option("--dataset.root", help="Your own LeRobotDataset instead of the simulator.")
    ] = None,
    dataset_repo_id: Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")] = "local/dataset",
    pi05: Annotated[
        str | None,
        typer.Option(
            help="Own data: the π0.5 to start from (folder or hub id), converted for each arm; none trains from scratch."
        ),
    ] = None,
    arms: Annotated[str, typer.Option(help="Own data: arms, with commas.")] = "blind,rgb,random,geometry",
    seeds: Annotated[str, typer.Option(help="Own data: training seeds, with commas.")] = "0,1,2",
    steps: Annotated[int, typer.Option(help="Own data: training steps of every run.")] = 3000,
    held_out: Annotated[float, typer.Option(help="Own data: share of the episodes to evaluate on.")] = 0.2,
    frames: Annotated[int, typer.Option(help="Own data: frames to evaluate of each held-out episode.")] = 20,
) -> None:
    """Does geometry help? Train and evaluate every arm of a study, and write its report.

    A study is tasks x arms x training seeds x conditions. Started again after an interruption, it continues; finished runs
    are kept. On several machines that share the output folder, start it with torchrun on each
    (`torchrun --nnodes 2 --nproc-per-node 4 --no-python pi05-geometry study --workers 1 ...`).

    With --dataset.root the study runs on your own dataset: it trains on most episodes and measures the action error on the
    others. All further options go to lerobot-train (`--policy.dtype=bfloat16 --policy.device=cuda --batch_size=8`).
    """
    from lerobot_policy_pi05_geometry.study.launch import rank, ranks, wait_for

    given = _given_options(context)
    if retry_crashed and ranks() > 1:
        raise ValueError(
            f"--retry-crashed is for a study without a launcher: a rank cannot tell an old crash from a new one. Remove "
            f"{output}/runs/*/crashed.json instead, and start the ranks without it."
        )
    if dataset_root is None:
        foreign = [*(given[name][0] for name in _OF_OWN_DATA if name in given), *context.args]
        if foreign:
            raise ValueError(
                f"{foreign[0]} is not an option of a simulated study; put the budget into a --spec file, or give your own data "
                "with --dataset.root."
            )
        if smoke and spec not in _SMOKES:
            raise ValueError(
                f"--smoke goes with --spec {' or '.join(_SMOKES)}, got '{spec}'; leave out one of the two."
            )
        name = _SMOKES[spec] if smoke else spec
        if estimate:
            _print_estimate(name, output)
            return
        path = _simulated_study(name, output, workers, retry_crashed, _command(context))
    else:
        from lerobot.utils.device_utils import auto_select_torch_device

        from lerobot_policy_pi05_geometry.study.held_out import held_out_runs
        from lerobot_policy_pi05_geometry.study.held_out_report import write_held_out_report

        foreign = [given[name][0] for name in _SIMULATED if name in given]
        if foreign:
            raise ValueError(f"{foreign[0]} is an option of a simulated study; leave it or --dataset.root out.")
        options = _forwarded(context.args)
        try:
            numbers = [int(seed) for seed in seeds.split(",")]
        except ValueError as error:
            raise ValueError(f"--seeds must be whole numbers with commas between them, got '{seeds}'.") from error
        runs = held_out_runs(
            output, dataset_root, dataset_repo_id, arms.split(","), numbers, options, steps, held_out, frames, pi05
        )
        device = options.get("policy.device") or auto_select_torch_device().type  # LeRobot's choice
        if workers is None and device != "cpu":
            workers = 1  # one run at a time on an accelerator
        _execute(runs, workers, retry_crashed)
        wait_for(runs)
        _print_crashed(runs)
        path = write_held_out_report(output, runs, _command(context)) if rank() == 0 else None
    if path is not None:
        console.print(f"Open [bold]{path}[/bold]")


_OF_OWN_DATA = ("dataset_repo_id", "pi05", "arms", "seeds", "steps", "held_out", "frames")
_SIMULATED = ("spec", "estimate", "smoke")
_SMOKES = {"default": "smoke", "smoke": "smoke", "warm-start": "warm-start-smoke"}


def _given_options(context: typer.Context) -> dict[str, list[str]]:
    """The options that stand on the command line: name -> how they are written, with their value."""
    given = {}
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name)
        if source is not None and source.name == "COMMANDLINE":
            value = context.params[parameter.name]
            given[parameter.name] = [parameter.opts[0], *([] if value is True else [str(value)])]
    return given


def _command(context: typer.Context) -> str:
    """The command of a study with every option that was given, so that a reader of its report can repeat it."""
    words = [word for option in _given_options(context).values() for word in option]
    return shlex.join(["pi05-geometry", "study", *words, *context.args])


def _forwarded(arguments: list[str]) -> dict[str, str]:
    """Options for lerobot-train: name -> value."""
    options = {}
    for argument in arguments:
        name, separator, value = argument.removeprefix("--").partition("=")
        if not argument.startswith("--") or not separator:
            raise ValueError(f"Options for lerobot-train are written --name=value, got '{argument}'.")
        options[name] = value
    return options


def _simulated_study(name: str, output: Path, workers: int | None, retry_crashed: bool, command: str) -> Path | None:
    """Execute this rank's share of a simulated study, phase by phase; rank 0 writes the report."""
    from lerobot_policy_pi05_geometry.sim.configuration import require_mujoco

    require_mujoco()
    from lerobot_policy_pi05_geometry.study.growth_report import write_growth_report
    from lerobot_policy_pi05_geometry.study.launch import rank, wait_for
    from lerobot_policy_pi05_geometry.study.plan import phases
    from lerobot_policy_pi05_geometry.study.pretraining import PretrainingRun
    from lerobot_policy_pi05_geometry.study.report import write_report
    from lerobot_policy_pi05_geometry.study.simulated import SimulatedRun
    from lerobot_policy_pi05_geometry.study.spec import read_spec, require_tasks

    spec = read_spec(name)
    require_tasks(spec)
    if workers is None and spec.budget.device != "cpu":
        workers = 1  # one run at a time on an accelerator
    grows = spec.growth.multiples != (1,) or spec.sweep is not None
    if grows and rank() == 0:
        _print_estimate(name, output)
    runs: list[PretrainingRun | SimulatedRun] = []
    for phase in phases(spec, output):
        console.print(f"{phase.title} ({len(phase.runs)} runs)", soft_wrap=True)
        _execute(phase.runs, workers, retry_crashed)
        wait_for(phase.runs)
        runs += phase.runs
    _print_crashed(runs)
    if rank() > 0:
        return None
    if grows:
        return write_growth_report(output, spec, runs, command)
    return write_report(output, [run for run in runs if isinstance(run, SimulatedRun)], command)


def _print_estimate(name: str, output: Path) -> None:
    from lerobot_policy_pi05_geometry.sim.configuration import require_mujoco

    require_mujoco()
    from lerobot_policy_pi05_geometry.study.estimate import estimate, measure_costs
    from lerobot_policy_pi05_geometry.study.spec import read_spec, require_tasks

    spec = read_spec(name)
    require_tasks(spec)
    costs = measure_costs(spec.budget, spec.comparisons[0].tasks[0])
    hours = estimate(spec, output, costs)
    console.print(
        f"Estimate of what is left: {hours.least:.1f} core-hours if every arm stops improving as early as the rule allows, "
        f"{hours.most:.1f} if none does ({1000 * costs.step:.0f} ms for a training step, {costs.episode:.1f} s for an "
        "evaluation episode, in one thread).",
        soft_wrap=True,
    )


def _execute(runs: "Sequence[Run]", workers: int | None, retry_crashed: bool) -> None:
    from lerobot_policy_pi05_geometry.study.launch import default_workers, launch, share

    with progress_bars() as bars:
        launch(share(runs), workers or default_workers(), _study_progress(bars), retry_crashed)


def _print_crashed(runs: "Sequence[Run]") -> None:
    for run in {run.folder: run for run in runs if run.crash.exists()}.values():
        console.print(f"[bold red]Crashed[/bold red] {run.name}: see {escape(str(run.log))}", soft_wrap=True)


def _study_progress(bars: Progress) -> "Callable[[StudyProgress], None]":
    """A bar for the whole study, and one for each running job."""
    whole = bars.add_task("all runs", total=None)
    task_ids: dict[str, TaskID] = {}

    def update(progress: "StudyProgress") -> None:
        bars.update(whole, completed=progress.done, total=progress.total)
        running = {job.run.name: job for job in progress.jobs}
        for name in set(task_ids) - set(running):
            bars.remove_task(task_ids.pop(name))
        for name, job in running.items():
            if name not in task_ids:
                task_ids[name] = bars.add_task(name, total=None)
            bars.update(task_ids[name], description=f"{name}: {job.stage}", completed=job.done, total=job.total or None)

    return update
