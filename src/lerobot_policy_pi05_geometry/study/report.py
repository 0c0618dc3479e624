"""The report of a simulated study: the result first, then the figures, then the limitations."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors import safe_open

from ..checkpoint.load import load_policy
from ..inspect.charts import curves_figure, success_figure
from ..inspect.inspection import frame_batch
from ..inspect.page import Page, picture, video
from ..inspect.pictures import depth_figure, layout_figure, segment_share_figure
from ..sim.libero.floors import Floor
from .arms import ARMS
from .conditions import find_condition, order_of
from .results import ArmComparison, Cell, cells, comparisons, episodes_table, on_common_tasks, pooled_difference
from .runs import file_name
from .simulated import SimulatedRun
from .simulated_tasks import simulated_task
from .training_log import read_curve

_SHOWN_IN_VIDEOS = ("geometry", "rgb", "random")


def write_report(folder: Path, runs: Sequence[SimulatedRun], command: str) -> Path:
    """Write report.html, episodes.csv, episodes.parquet and the pictures; returns the path of the page.

    command: how the study was started; shown so that a reader can repeat it.
    """
    table = episodes_table(runs)
    table.to_csv(folder / "episodes.csv", index=False)
    table.to_parquet(folder / "episodes.parquet", index=False)
    pictures = folder / "pictures"
    pictures.mkdir(exist_ok=True)
    found, versus = cells(table), comparisons(table)
    page = Page("Does geometry help?")
    page.lead(headline(table))
    _setup(page, runs)
    for task in dict.fromkeys(run.task for run in runs):
        _task(page, task, [c for c in found if c.task == task], [v for v in versus if v.task == task], runs, pictures)
    _trained_policy(page, runs, pictures)
    page.heading("Limitations")
    page.text(
        "The networks are small, depth is simulated, the experts are scripted and the tasks are few. The gain of the "
        "released π0.5 on a real robot is not measured here. Wilson intervals and McNemar's test treat "
        "all episodes of an arm as independent and ignore the variation between training seeds. The intervals of differences "
        f"resample training seeds, of which there are {len({run.seed for run in runs})}. A difference with a corrected p above "
        "0.05 is not significant."
    )
    page.heading("To repeat this study")
    page.code(command)
    path = folder / "report.html"
    page.write(path)
    return path


def floor_sentence(floor: Floor) -> str:
    """What was measured of a task beforehand: its expert, and the plan that never looks."""
    return (
        f"Measured beforehand, on other seeds: {floor}. The blind plan knows the mean places of all objects and never looks; "
        "success that does not exceed it does not show that a policy sees."
    )


def headline(table: pd.DataFrame) -> str:
    """The result: geometry against RGB only with the camera outside the training range, with intervals."""
    rows = pd.concat(on_common_tasks(table, *((arm, "outside") for arm in _COMPARED)))
    if rows.empty:
        best = max(cells(table), key=lambda cell: cell.rate)
        return f"The best cell of this study is {best.arm} under '{best.condition}': {_cell(best)}."
    arms = {cell.arm: cell for cell in cells(rows.assign(task="all"))}
    geometry, rgb = arms["geometry"], arms["rgb"]
    apart = geometry.interval()[0] > rgb.interval()[1] or rgb.interval()[0] > geometry.interval()[1]
    verdict = "the intervals do not overlap" if apart else "the intervals overlap, so the difference is not established"
    text = (
        "With the camera outside the range it was trained on, the policy with geometry succeeds in "
        f"{_cell(geometry)} of episodes and RGB only in {_cell(rgb)}: {verdict}."
    )
    tasks, evaluated = list(rows["task"].unique()), table.loc[table["condition"] == "outside", ["arm", "task"]]
    if set(tasks) < set(evaluated.loc[evaluated["arm"].isin(_COMPARED), "task"]):
        text += f" Both were evaluated on {', '.join(tasks)}."
    if rows["training_seed"].nunique() > 1:
        difference, low, high = (100 * points for points in pooled_difference(rows, *_COMPARED))
        text += (
            f" The difference is {difference:+.0f} points ({low:+.0f} to {high:+.0f}, 95 % bootstrap over training seeds and "
            "episodes)."
        )
    text += _without_depth(table)
    controls = ", ".join(filter(None, (_control(name, table, arm, tasks) for arm, name in _NAMES.items())))
    return text + (f" For comparison: {controls}." if controls else "")


def _without_depth(table: pd.DataFrame) -> str:
    """Geometry with its depth camera off, beside RGB only with the same cameras; empty if it was not evaluated."""
    rows = on_common_tasks(table, ("geometry", "depth-off"), ("rgb", "inside"))
    if rows[0].empty:
        return ""
    geometry, rgb = (cells(of_arm.assign(task="all"))[0] for of_arm in rows)
    return (
        f" With its depth camera off and the camera within the range, geometry succeeds in {_cell(geometry)}, "
        f"RGB only in {_cell(rgb)}."
    )


def _control(name: str, table: pd.DataFrame, arm: str, tasks: Sequence[str]) -> str:
    """The rate of an arm outside; if on other tasks than these, with geometry's rate on the same. Empty if not evaluated."""
    of_arm, of_geometry = on_common_tasks(table, (arm, "outside"), ("geometry", "outside"))
    if of_arm.empty:
        return ""
    text, own = f"{name} {of_arm['success'].mean():.0%}", list(of_arm["task"].unique())
    if set(own) != set(tasks):
        text += f" (on {', '.join(own)}, where geometry has {of_geometry['success'].mean():.0%})"
    return text


_COMPARED = ("geometry", "rgb")
_NAMES = {"rgb-wide": "RGB trained on the wide camera range", "random": "random tokens", "blind": "no camera"}


def _setup(page: Page, runs: Sequence[SimulatedRun]) -> None:
    budget, origin = runs[0].budget, runs[0].origin
    if origin is not None:
        about = origin.pretraining
        page.text(
            f"Every arm starts from one small π0.5 that was trained on RGB for {about.steps} steps ({', '.join(about.tasks)}, "
            f"cameras '{about.cameras}', {about.episodes} expert episodes of each task), exported to LeRobot's layout and "
            "converted for the arm."
        )
    seeds = len({run.seed for run in runs})
    page.text(
        f"{len(runs)} training runs: {budget.episodes} expert episodes, {budget.steps} steps of {budget.batch_size} samples "
        f"with {budget.flow_samples} flow samples each, {seeds} training seed{'s' if seeds > 1 else ''}; data, budget and "
        f"sizes are the same for every arm. Every cell has {budget.evaluation_episodes} unseen evaluation seeds per training "
        f"seed, the same for every arm. A new chunk is predicted every {budget.action_steps} steps. All episodes are in "
        "episodes.csv."
    )
    crashed = [run for run in runs if run.crash.exists()]
    if crashed:
        page.text(
            "Crashed runs, counted as failures: "
            + "; ".join(f"{run.name} (log: {run.folder.name}/{run.log.name})" for run in crashed)
        )


def _task(
    page: Page, task: str, found: list[Cell], versus: list[ArmComparison], runs: Sequence[SimulatedRun], pictures: Path
) -> None:
    page.heading(task)
    floor = simulated_task(task).floor()
    if floor is not None:
        page.text(floor_sentence(floor))
    conditions = sorted({cell.condition for cell in found}, key=order_of)
    arms = [name for name in ARMS if any(cell.arm == name for cell in found)]
    by_name = {(cell.arm, cell.condition): cell for cell in found}
    bars = {arm: [_bar(by_name.get((arm, condition))) for condition in conditions] for arm in arms}
    titles = [find_condition(condition).title for condition in conditions]
    caption = "Success per arm and condition over all training seeds. The table has each training seed in brackets."
    page.row(picture(success_figure(titles, bars), caption, pictures / f"success_{file_name(task)}.png"))
    parameters = {run.arm_name: _parameters(run) for run in _finished(runs) if run.task == task}
    page.table(
        ["arm", "what it is", "parameters", *titles],
        [
            [
                arm,
                ARMS[arm].title,
                parameters.get(arm, "crashed"),
                *(_seeds(by_name.get((arm, c))) for c in conditions),
            ]
            for arm in arms
        ],
    )
    if versus:
        page.text(
            "Success of geometry minus success of each arm on the same seeds, in points, with the 95 % bootstrap interval over "
            "training seeds and episodes, and the exact McNemar p, corrected for all comparisons of the study (Holm)."
        )
        by_pair = {(v.arm, v.condition): v for v in versus}
        page.table(
            ["geometry minus", *titles],
            [[arm, *(_difference(by_pair.get((arm, c))) for c in conditions)] for arm in arms if arm != "geometry"],
        )
    for condition in [c for c in ("inside", "outside") if c in conditions]:
        shown = [arm for arm in _SHOWN_IN_VIDEOS if arm in arms]
        clips = _side_by_side([run for run in runs if run.task == task], shown, condition)
        if clips is not None:
            title = f"From left: {', '.join(shown)}. {find_condition(condition).title.capitalize()}."
            page.row(video(clips, 10, title, pictures / f"rollout_{file_name(task)}_{condition}.mp4"))


def _trained_policy(page: Page, runs: Sequence[SimulatedRun], pictures: Path) -> None:
    """Attention of a trained policy with geometry, and the training loss."""
    trained = _finished(runs)
    first = next((run for run in trained if run.arm_name == "geometry"), None)
    page.heading("Attention and training")
    if first is not None:
        loaded = load_policy(first.checkpoint)
        batch = loaded.preprocess(frame_batch(LeRobotDataset(first.recording.repo_id, root=first.data_folder), 0))
        caption = (
            "The first frame of the dataset. Right: attention of the action tokens on geometry at the last denoising "
            "step, mean over layers, heads and tokens."
        )
        page.row(picture(depth_figure(loaded.policy, batch), caption, pictures / "depth.png"))
        page.row(
            picture(
                layout_figure(loaded.policy, batch),
                "Rows are queries, columns are keys. The prefix does not attend to geometry; the actions attend to all segments.",
                pictures / "layout.png",
            ),
            picture(
                segment_share_figure(loaded.policy, batch),
                "Attention of the action tokens per segment and layer.",
                pictures / "shares.png",
            ),
        )
    same = [run for run in trained if (run.task, run.seed) == (trained[0].task, trained[0].seed)] if trained else []
    if same:
        curves = {run.arm_name: read_curve(run.log, run.log_every) for run in same}
        page.row(picture(curves_figure(curves), "Loss on training batches, first seed.", pictures / "curves.png"))


def _finished(runs: Sequence[SimulatedRun]) -> list[SimulatedRun]:
    """Runs that did not crash; the files of a crashed run may be incomplete."""
    return [run for run in runs if not run.crash.exists()]


_NOT_EVALUATED = "–"


def _bar(cell: Cell | None) -> tuple[float, float, float] | None:
    return None if cell is None else (cell.rate, *cell.interval())


def _cell(cell: Cell | None) -> str:
    if cell is None:
        return _NOT_EVALUATED
    low, high = cell.interval()
    crashed = f", {cell.crashed_runs} crashed" if cell.crashed_runs else ""
    return f"{cell.rate:.0%} ({low:.0%} to {high:.0%}{crashed})"


def _seeds(cell: Cell | None) -> str:
    """A cell, with the rate of every training seed if there are several."""
    if cell is None or len(cell.by_seed) == 1:
        return _cell(cell)
    return f"{_cell(cell)} [{', '.join(f'{100 * rate:.0f}' for rate in cell.by_seed)}]"


def _difference(versus: ArmComparison | None) -> str:
    if versus is None:
        return _NOT_EVALUATED
    result = versus.result
    p = "p < 0.001" if versus.p < 0.001 else f"p = {versus.p:.2g}"
    return f"{100 * result.difference:+.0f} ({100 * result.low:+.0f} to {100 * result.high:+.0f}), {p}"


def _parameters(run: SimulatedRun) -> str:
    with safe_open(run.checkpoint / "model.safetensors", framework="pt") as file:
        return f"{sum(np.prod(file.get_slice(key).get_shape()) for key in file.keys()):,.0f}"  # noqa: SIM118


def _side_by_side(runs: Sequence[SimulatedRun], arms: Sequence[str], condition: str) -> np.ndarray | None:
    """The first episodes of these arms on the same seeds, concatenated, (T, H, arms * W, 3)."""
    of_arm = {run.arm_name: run.evaluation(condition) for run in reversed(runs) if not run.crash.exists()}
    evaluations = [of_arm[arm] for arm in arms if of_arm.get(arm) is not None]
    if len(evaluations) != len(arms) or not arms:
        return None
    clips = []
    for episode in zip(*(evaluation.videos for evaluation in evaluations), strict=True):
        length = max(len(clip) for clip in episode) + 5  # a pause between episodes
        padded = [np.concatenate([clip, clip[-1:].repeat(length - len(clip), axis=0)]) for clip in episode]
        clips.append(np.concatenate(padded, axis=2))
    return np.concatenate(clips) if clips else None
