"""The report of a study that trains with several multiples of its budget: claims, curves, stop rule, azimuth sweep."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ..inspect.charts import growth_figure, success_figure, sweep_figure
from ..inspect.page import Page, picture
from ..sim.cameras import CAMERA_RANGES
from .arms import ARMS
from .claims import claims
from .conditions import azimuth_condition, azimuth_of, find_condition, order_of
from .pretraining import PretrainingRun
from .report import floor_sentence
from .results import cells, episodes_table, success_matrix
from .runs import file_name
from .simulated import SimulatedRun
from .simulated_tasks import simulated_task
from .spec import StudySpec
from .statistics import wilson
from .stopping import gains, improving_arms

HIGH_FLOOR = 0.15  # a task whose blind policy succeeds more often shows little


def write_growth_report(
    folder: Path, spec: StudySpec, runs: Sequence[PretrainingRun | SimulatedRun], command: str
) -> Path:
    """Write report.html, episodes.csv, episodes.parquet, claims.csv and the pictures; returns the path of the page.

    runs: of all phases. command: how the study was started; shown so that a reader can repeat it.
    """
    simulated = [run for run in runs if isinstance(run, SimulatedRun)]
    table = episodes_table(simulated).drop_duplicates(ignore_index=True)  # a condition may be compared and swept
    table.to_csv(folder / "episodes.csv", index=False)
    table.to_parquet(folder / "episodes.parquet", index=False)
    pictures = folder / "pictures"
    pictures.mkdir(exist_ok=True)
    named = {name for comparison in spec.comparisons for name in comparison.conditions}
    azimuths = [] if spec.sweep is None else [azimuth_condition(degrees) for degrees in spec.sweep.azimuths]
    compared, swept = (table[table["condition"].isin(names)] for names in (named, azimuths))
    final = _with_last_multiple(compared)
    page = Page("Warm start: does geometry help a pretrained π0.5?" if spec.pretraining else "Does geometry help?")
    found = claims(final, compared, spec.budget.steps)
    page.lead(" ".join(claim.sentence for claim in found[:1]))
    pd.DataFrame([vars(claim) for claim in found]).to_csv(folder / "claims.csv", index=False)
    page.table(["claim", "holds", "measured"], [[c.claim, c.verdict, c.sentence] for c in found])
    _setup(page, spec, runs)
    _floors(page, final)
    _curves(page, spec, compared, pictures)
    _stop_rule(page, spec, compared)
    for task in final["task"].unique():
        _task(page, task, final[final["task"] == task], pictures)
    if spec.sweep is not None and len(swept):
        _sweep(page, spec, _with_last_multiple(swept), pictures)
    page.heading("Limitations")
    page.text(
        "The networks are small and were pretrained on few simulated tasks; depth is simulated and the experts are "
        "scripted. The gain of the released π0.5 on a real robot is not measured here. Depth Anything 3 is not an arm: its "
        "architecture with random weights says nothing about the released encoder. An arm that stopped improving by the "
        "rule may still improve with more steps. One-shot modulation gets one demonstration per condition: at one azimuth "
        "this is the setting of its paper, in a range of poses it is harder."
    )
    page.heading("To repeat this study")
    page.code(command)
    path = folder / "report.html"
    page.write(path)
    return path


def _with_last_multiple(table: pd.DataFrame) -> pd.DataFrame:
    """The episodes of each arm's longest training."""
    last = table.groupby("arm")["multiple"].transform("max")
    return table[table["multiple"] == last]


def _setup(page: Page, spec: StudySpec, runs: Sequence[PretrainingRun | SimulatedRun]) -> None:
    budget = spec.budget
    for run in runs:
        if isinstance(run, PretrainingRun):
            about = run.pretraining
            outcomes = {task: run.evaluation(task) for task in about.evaluated}
            rates = ", ".join(f"{task} {outcome.rate:.0%}" for task, outcome in outcomes.items() if outcome is not None)
            page.text(
                f"Every arm starts from one π0.5 trained on RGB for {about.steps} steps on {len(about.tasks)} tasks with "
                f"{about.episodes} expert episodes each, cameras '{about.cameras}'."
                + (f" Its success: {rates}." if rates else "")
            )
    seeds = len(spec.seeds)
    page.text(
        f"Fine-tuning: {budget.episodes} expert episodes, {budget.steps} steps of {budget.batch_size} samples with "
        f"{budget.flow_samples} flow samples each, times {', '.join(map(str, spec.growth.multiples))}; {seeds} training "
        f"seed{'s' if seeds > 1 else ''}. Each multiple is a training of its own with its own learning-rate schedule. Every "
        f"cell has {budget.evaluation_episodes} evaluation seeds per training seed, the same for every arm."
    )
    crashed = sorted({run.name for run in runs if run.crash.exists()})
    if crashed:
        page.text(f"Crashed runs, counted as failures: {', '.join(crashed)}.")


def _floors(page: Page, final: pd.DataFrame) -> None:
    """Name tasks on which a policy without a camera succeeds too often for a fair test."""
    blind = final[(final["arm"] == "blind") & (final["condition"] == "outside")]
    for task, rows in blind.groupby("task", sort=False):
        if rows["success"].mean() >= HIGH_FLOOR:
            page.text(
                f"The blind policy succeeds in {rows['success'].mean():.0%} of the episodes of {task}, more than "
                f"{HIGH_FLOOR:.0%}: this task says little about seeing."
            )


def _curves(page: Page, spec: StudySpec, compared: pd.DataFrame, pictures: Path) -> None:
    page.heading("Success against training steps")
    panels = [(task, condition) for task in compared["task"].unique() for condition in spec.growth.conditions]
    arms = [arm for arm in ARMS if arm != "blind" and (compared["arm"] == arm).any()]
    curves = {arm: [_curve(spec, compared, arm, panel) for panel in panels] for arm in arms}
    floors = []
    for panel in panels:
        of_blind = _curve(spec, compared, "blind", panel)
        floors.append(float(np.mean(of_blind[max(of_blind)])) if of_blind else None)
    figure = growth_figure(
        [f"{task}: {condition}" for task, condition in panels],
        [multiple * spec.budget.steps for multiple in spec.growth.multiples],
        curves,
        floors,
    )
    caption = "Thin lines: training seeds. Thick lines: their mean. Dotted: the policy without a camera."
    page.row(picture(figure, caption, pictures / "growth.png"))


def _curve(spec: StudySpec, table: pd.DataFrame, arm: str, panel: tuple[str, str]) -> dict[int, list[float]]:
    """Success rate of every training seed, by training steps. panel: task and condition."""
    task, condition = panel
    rows = table[(table["arm"] == arm) & (table["task"] == task) & (table["condition"] == condition)]
    return {
        int(multiple) * spec.budget.steps: list(success_matrix(of_multiple).mean(axis=1))
        for multiple, of_multiple in rows.groupby("multiple")
    }


def _stop_rule(page: Page, spec: StudySpec, compared: pd.DataFrame) -> None:
    found = gains(compared, spec.growth)
    page.heading("Which arms have stopped improving")
    page.text(
        f"An arm has stopped improving if its last gain, pooled over training seeds and tasks, is below "
        f"{100 * spec.growth.gain:.0f} points under each of: {', '.join(spec.growth.conditions)}. Gains in points, with 95 % "
        "bootstrap intervals over training seeds and episodes."
    )
    improving = improving_arms(found, spec.growth)
    page.table(
        ["arm", "condition", "steps", "gain", "verdict"],
        [
            [
                gain.arm,
                gain.condition,
                f"to {gain.multiple * spec.budget.steps:,}",
                f"{100 * gain.gain:+.0f} ({100 * gain.low:+.0f} to {100 * gain.high:+.0f})",
                "still improving" if gain.arm in improving else "stopped",
            ]
            for gain in found
        ],
    )


def _task(page: Page, task: str, rows: pd.DataFrame, pictures: Path) -> None:
    page.heading(task)
    floor = simulated_task(task).floor()
    if floor is not None:
        page.text(floor_sentence(floor))
    found = {(cell.arm, cell.condition): cell for cell in cells(rows)}
    arms = [arm for arm in ARMS if any(key[0] == arm for key in found)]
    names = sorted({condition for _, condition in found}, key=order_of)
    bars = {}
    for arm in arms:
        of_arm = [found.get((arm, name)) for name in names]
        bars[arm] = [None if cell is None else (cell.rate, *cell.interval()) for cell in of_arm]
    titles = [find_condition(name).title for name in names]
    caption = "Success after the longest training of each arm, over all training seeds."
    page.row(picture(success_figure(titles, bars), caption, pictures / f"success_{file_name(task)}.png"))
    multiples = rows.groupby("arm")["multiple"].max()
    table = []
    for arm in arms:
        texts = []
        for name in names:
            cell = found.get((arm, name))
            seeds = "" if cell is None else ", ".join(f"{100 * rate:.0f}" for rate in cell.by_seed)
            texts.append("–" if cell is None else f"{cell.rate:.0%} ({_range(cell.interval())}) [{seeds}]")
        table.append([arm, ARMS[arm].title, f"{multiples[arm]} x", *texts])
    page.table(["arm", "what it is", "steps", *titles], table)


def _range(interval: tuple[float, float]) -> str:
    return f"{interval[0]:.0%} to {interval[1]:.0%}"


def _sweep(page: Page, spec: StudySpec, swept: pd.DataFrame, pictures: Path) -> None:
    assert spec.sweep is not None
    page.heading("Azimuth sweep")
    tasks, azimuths = list(swept["task"].unique()), sorted(spec.sweep.azimuths)
    degrees = swept["condition"].map(azimuth_of)
    arms: dict[str, list[np.ndarray | None]] = {}
    for arm in [arm for arm in ARMS if (swept["arm"] == arm).any()]:
        arms[arm] = []
        for task in tasks:
            rows = swept[(swept["arm"] == arm) & (swept["task"] == task)]
            of_azimuth = [rows.loc[degrees[rows.index] == azimuth, "success"] for azimuth in azimuths]
            values = [(s.mean(), *wilson(int(s.sum()), len(s))) for s in of_azimuth if len(s)]
            arms[arm].append(np.array(values).T if len(values) == len(azimuths) else None)
    (trained,) = CAMERA_RANGES["train"].azimuth
    caption = "Success after the longest training of each arm at fixed azimuths, with 95 % Wilson intervals."
    page.row(picture(sweep_figure(tasks, azimuths, arms, trained), caption, pictures / "sweep.png"))
