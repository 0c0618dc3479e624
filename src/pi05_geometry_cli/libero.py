"""The commands for LIBERO: demonstrations rendered anew, floors, the report of an evaluation."""

from pathlib import Path
from typing import Annotated

import typer

from .app import Output, app, console, progress_bars

LiberoCameras = Annotated[str, typer.Option(help="Range of front camera poses: fixed, train, outside or plus.")]
Placement = Annotated[
    str, typer.Option(help="Where objects stand: stock (LIBERO's states), near (within 8 cm) or far (within 18 cm).")
]
Rendering = Annotated[str, typer.Option(help="full: as LeRobot's LIBERO. fast: no shadows, no multisampling.")]
TaskIds = Annotated[list[int] | None, typer.Option("--task-id", help="Task number, may be repeated; none is all.")]


@app.command("libero-replay")
def libero_replay(
    files: Annotated[list[Path], typer.Argument(help="LIBERO's original <task>_demo.hdf5 files.")],
    output: Output,
    cameras: LiberoCameras = "fixed",
    image_size: Annotated[int, typer.Option(help="Pixels per side of RGB and depth.", min=1)] = 256,
    rendering: Rendering = "full",
    limit: Annotated[int | None, typer.Option(help="Demonstrations of each file; none is all.", min=1)] = None,
) -> None:
    """Render LIBERO's original demonstrations anew, with depth and calibration, into a LeRobotDataset v3."""
    from lerobot_policy_pi05_geometry.sim.libero.replay import replay

    missing = [str(file) for file in files if not file.is_file()]
    if missing:
        raise typer.BadParameter(f"{', '.join(missing)}: no such file.")
    kept = 0
    for done in replay(
        files, output, f"local/{output.name}", cameras, image_size=image_size, rendering=rendering, limit=limit
    ):
        kept += not done.reason
        console.print(
            f"{done.demonstration}: " + (f"left out, {done.reason}" if done.reason else f"{done.frames} frames")
        )
    console.print(f"{kept} demonstrations are in {output}.")


@app.command("libero-floors")
def libero_floors(
    output: Annotated[Path, typer.Option(help="JSON file; entries that are not measured anew stay.")],
    suite: Annotated[str, typer.Option(help="libero_spatial, libero_object or libero_goal.")] = "libero_spatial",
    task_id: TaskIds = None,
    placement: Placement = "stock",
    episodes: Annotated[int, typer.Option(help="Episodes of the expert.")] = 50,
    blind_episodes: Annotated[
        int | None, typer.Option(help="Episodes of the blind plan, on the first of the same seeds. Default: as many.")
    ] = None,
) -> None:
    """Measure how often the scripted expert succeeds, and how often a plan that never looks."""
    from lerobot_policy_pi05_geometry.sim.libero.floors import measure, write_floors
    from lerobot_policy_pi05_geometry.sim.libero.tasks import find_task, suite_tasks

    numbers = task_id or range(len(suite_tasks(suite)))
    with progress_bars() as bars:
        bar = bars.add_task("measure floors", total=len(numbers))
        for number in numbers:
            floor = measure(
                find_task(suite, number),
                placement,
                episodes,
                episodes if blind_episodes is None else blind_episodes,
                say=lambda text: bars.update(bar, description=text),
            )
            write_floors([floor], output)
            console.print(f"{suite}/{number}, {placement}: {floor}")
            bars.advance(bar)


@app.command("libero-report")
def libero_report(
    folder: Annotated[Path, typer.Argument(help="Folder that lerobot-eval wrote (its --output_dir).")],
    placement: Placement = "stock",
    floors: Annotated[
        Path | None, typer.Option(help="File of libero-floors. Default: the floors of this package.")
    ] = None,
) -> None:
    """Success per task of a lerobot-eval on LIBERO, with intervals and floors; written to report.md too."""
    from lerobot_policy_pi05_geometry.sim.libero.floors import FLOORS_FILE
    from lerobot_policy_pi05_geometry.sim.libero.report import read_results, report

    if floors is not None and not floors.is_file():
        raise typer.BadParameter(f"{floors}: no such file.")
    text = report(read_results(folder, placement, floors or FLOORS_FILE), placement)
    (folder / "report.md").write_text(text)
    console.print(text, markup=False)
