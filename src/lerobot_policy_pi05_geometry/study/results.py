"""Results of a study: a table with one row per episode, and success rates and comparisons computed from it.

The episodes of a crashed run are in the table as failures, marked `crashed`. Without them an arm that often crashes would
appear better than it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from .arms import ARMS
from .conditions import order_of
from .simulated import SimulatedRun
from .statistics import Difference, bootstrap, compare, holm, wilson


def episodes_table(runs: Sequence[SimulatedRun]) -> pd.DataFrame:
    """One row per episode: task, arm, multiple, training_seed, condition, episode_seed, success, steps, crashed.

    multiple: of the budget's training steps. steps: of the episode.

    Raises ValueError if a run is neither complete nor crashed.
    """
    rows = []
    for run in runs:
        for condition in run.conditions:
            evaluation = run.evaluation(condition)
            crashed = evaluation is None and run.crash.exists()
            if evaluation is None and not crashed:
                raise ValueError(
                    f"Run {run.name} has not been evaluated under '{condition}'; start the study again to complete it."
                )
            if evaluation is None:
                seeds = list(range(run.budget.evaluation_episodes))
                outcomes = [(seed, False, 0) for seed in seeds]
            else:
                outcomes = list(zip(evaluation.seeds, evaluation.successes, evaluation.steps, strict=True))
            rows += [
                (run.task, run.arm_name, run.multiple, run.seed, condition, seed, success, steps, crashed)
                for seed, success, steps in outcomes
            ]
    columns = ["task", "arm", "multiple", "training_seed", "condition", "episode_seed", "success", "steps", "crashed"]
    return pd.DataFrame(rows, columns=columns)


@dataclass(frozen=True)
class Cell:
    """Success of an arm on a task under a condition, over all training seeds; by_seed: the rate of each of them."""

    task: str
    arm: str
    condition: str
    successes: int
    episodes: int
    crashed_runs: int
    by_seed: tuple[float, ...]

    @property
    def rate(self) -> float:
        return self.successes / self.episodes

    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval."""
        return wilson(self.successes, self.episodes)


def cells(table: pd.DataFrame) -> list[Cell]:
    """Every cell of a study, in the order of ARMS and of `order_of` its condition."""
    found = []
    for (task, arm, condition), rows in table.groupby(["task", "arm", "condition"], sort=False):
        crashed = rows.loc[rows["crashed"], "training_seed"].nunique()
        by_seed = tuple(rows.groupby("training_seed")["success"].mean())
        found.append(Cell(task, arm, condition, int(rows["success"].sum()), len(rows), crashed, by_seed))
    arms = list(ARMS)
    return sorted(found, key=lambda cell: (cell.task, arms.index(cell.arm), order_of(cell.condition)))


@dataclass(frozen=True)
class ArmComparison:
    """The reference arm against one other arm; `p` is corrected for all comparisons of the study."""

    task: str
    condition: str
    arm: str
    reference: str
    result: Difference
    p: float


def comparisons(table: pd.DataFrame, reference: str = "geometry") -> list[ArmComparison]:
    """Every arm against the reference arm, on the same seeds, per task and condition."""
    found: list[tuple[str, str, str, Difference]] = []
    for (task, condition), rows in table.groupby(["task", "condition"], sort=False):
        matrices = {arm: success_matrix(of_arm) for arm, of_arm in rows.groupby("arm", sort=False)}
        if reference in matrices:
            found += [
                (task, condition, arm, compare(matrices[reference], matrix))
                for arm, matrix in matrices.items()
                if arm != reference
            ]
    corrected = holm([difference.p for *_, difference in found])
    return [
        ArmComparison(task, condition, arm, reference, difference, p)
        for (task, condition, arm, difference), p in zip(found, corrected, strict=True)
    ]


def pooled_difference(rows: pd.DataFrame, arm: str, over: str) -> tuple[float, float, float]:
    """Success of one arm minus another's, averaged over the tasks in `rows`: mean, low, high.

    rows: of one condition, on tasks that both arms have (`on_common_tasks`).
    """
    pairs = [
        [success_matrix(of_task[of_task["arm"] == name]) for name in (arm, over)] for _, of_task in rows.groupby("task")
    ]
    return bootstrap(*(first.astype(float) - second.astype(float) for first, second in pairs))


def on_common_tasks(table: pd.DataFrame, *sides: tuple[str, str]) -> list[pd.DataFrame]:
    """The rows of each (arm, condition) on the tasks that all of them have; without rows if there is no such task.

    Arms of different [[compare]] blocks have different tasks, and pooled over these the easier tasks would win.
    """
    rows = [table[(table["arm"] == arm) & (table["condition"] == condition)] for arm, condition in sides]
    common = set.intersection(*(set(of_side["task"]) for of_side in rows))
    return [of_side[of_side["task"].isin(common)] for of_side in rows]


def success_matrix(rows: pd.DataFrame) -> np.ndarray:
    """Success by (training seed, episode seed), bool."""
    return rows.pivot(index="training_seed", columns="episode_seed", values="success").to_numpy(dtype=bool)
