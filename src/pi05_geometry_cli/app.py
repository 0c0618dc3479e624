"""The application, its console, progress bars, and options shared by several commands."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help="π0.5 with a geometry segment."
)
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


def progress_bars() -> Progress:
    return Progress(
        TextColumn("{task.description:<48}"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def require_simulator() -> None:
    from lerobot_policy_pi05_geometry.sim.configuration import require_simulator as require

    require()
