"""The commands of the simulated robot: record, train, evaluate."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from .app import Cameras, Output, Sensor, Task, app, console, progress_bars, require_simulator
from .libero import Placement, Rendering, TaskIds


@app.command()
def record(
    output: Output,
    task: Task = "button-press-topdown-wide",
    episodes: Annotated[int, typer.Option(help="Successful expert episodes to record, of each task.", min=1)] = 100,
    cameras: Annotated[str, typer.Option(help="Range of camera poses, of the environment's own ranges.")] = "train",
    image_size: Annotated[int, typer.Option(help="Pixels per side of RGB and depth.", min=1)] = 84,
    seed: Annotated[int, typer.Option(help="Selects the recorded episodes.")] = 0,
    env: Annotated[
        str, typer.Option(help="metaworld_rgbd, or libero_rgbd with --task as its suite.")
    ] = "metaworld_rgbd",
    task_id: TaskIds = None,
    placement: Placement = "stock",
    rendering: Rendering = "full",
) -> None:
    """Record scripted experts into a LeRobotDataset v3 with depth and calibration.

    --task-id, --placement and --rendering are for libero_rgbd.
    """
    attempts: Iterator[tuple[int, bool]]
    repo_id, total = f"local/{output.name}", episodes
    if env == "metaworld_rgbd":
        require_simulator()
        from lerobot_policy_pi05_geometry.sim.record import record as record_episodes

        attempts = record_episodes(output, repo_id, task, episodes, cameras, image_size, seed=seed)
    elif env == "libero_rgbd":
        from lerobot_policy_pi05_geometry.sim.libero.environment import RgbdLiberoEnv
        from lerobot_policy_pi05_geometry.sim.libero.record import record as record_libero
        from lerobot_policy_pi05_geometry.sim.libero.tasks import suite_tasks

        environments = [
            RgbdLiberoEnv(task, number, cameras, placement, image_size=image_size, rendering=rendering)
            for number in (task_id or range(len(suite_tasks(task))))
        ]
        total = episodes * len(environments)
        attempts = record_libero(output, repo_id, environments, episodes, seed)
    else:
        raise typer.BadParameter(f"There is no environment '{env}' to record; choose metaworld_rgbd or libero_rgbd.")
    with progress_bars() as bars:
        bar = bars.add_task("record expert episodes", total=total)
        for done, _ in attempts:
            bars.update(bar, completed=done)
    console.print(
        f"Train on it: lerobot-train --policy.type=pi05_geometry --dataset.repo_id=local/{output.name} "
        f"--dataset.root={output} ..."
    )


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})
def train(context: typer.Context) -> None:
    """lerobot-train, with the same arguments, and decoded frames kept in memory. For small datasets of images."""
    from lerobot_policy_pi05_geometry.study.frames_in_memory import train_in_memory

    sys.argv = ["lerobot-train", *context.args]  # LeRobot parses the command line itself
    train_in_memory()


@app.command()
def evaluate(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    task: Task = "button-press-topdown-wide",
    cameras: Cameras = "train",
    sensor: Sensor = "ideal",
    episodes: Annotated[int, typer.Option(help="Episodes to run.", min=1)] = 50,
    first_seed: Annotated[int, typer.Option(help="Seed of the first episode; the next ones count up.")] = 0,
    image_size: Annotated[int, typer.Option(help="Pixels per side, as in training.", min=1)] = 84,
    device: Annotated[str, typer.Option(help="Where the policy runs.")] = "cpu",
    output: Annotated[Path | None, typer.Option(help="JSON file for the outcome of every episode.")] = None,
) -> None:
    """Success rate of a checkpoint on a simulated task, with its 95 % interval."""
    import json

    require_simulator()
    from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
    from lerobot_policy_pi05_geometry.sim.configuration import MetaworldRgbdEnv
    from lerobot_policy_pi05_geometry.sim.evaluate import evaluate as run

    environment = MetaworldRgbdEnv(task=task, cameras=cameras, sensor=sensor, image_size=image_size)
    loaded = load_policy(checkpoint, device, environment)
    with progress_bars() as bars:
        bar = bars.add_task(f"{task}, {cameras}", total=episodes)
        result = run(loaded, environment, episodes, first_seed, progress=lambda done: bars.update(bar, completed=done))
    low, high = result.interval()
    console.print(f"{result.rate:.0%} of {episodes} episodes succeed (95 % interval {low:.0%} to {high:.0%}).")
    if output is not None:
        output.write_text(json.dumps(result.to_json(), indent=2))
