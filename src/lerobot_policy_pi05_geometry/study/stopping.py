"""The rule by which an arm has stopped improving: the gain from one multiple of the steps to the next."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from .results import success_matrix
from .spec import Growth
from .statistics import bootstrap


@dataclass(frozen=True)
class Gain:
    """Success with `multiple` times the steps minus success with the multiple before it, pooled over tasks and seeds.

    low, high: 95 % bootstrap interval over training seeds and episodes.
    """

    arm: str
    condition: str
    multiple: int
    gain: float
    low: float
    high: float


def gains(table: pd.DataFrame, growth: Growth) -> list[Gain]:
    """The gains of every arm between neighbouring multiples that it was trained with, under the rule's conditions."""
    found = []
    rows = table[table["condition"].isin(growth.conditions)]
    for (arm, condition), of_arm in rows.groupby(["arm", "condition"], sort=False):
        for before, after in itertools.pairwise(sorted(of_arm["multiple"].unique())):
            differences = [
                success_matrix(of_task[of_task["multiple"] == after]).astype(float)
                - success_matrix(of_task[of_task["multiple"] == before])
                for _, of_task in of_arm.groupby("task", sort=False)
            ]
            found.append(Gain(arm, condition, int(after), *bootstrap(*differences)))
    return found


def improving_arms(found: Sequence[Gain], growth: Growth) -> set[str]:
    """Arms whose last gain reaches the threshold under at least one of the rule's conditions."""
    last = {arm: max(gain.multiple for gain in found if gain.arm == arm) for arm in {gain.arm for gain in found}}
    return {gain.arm for gain in found if gain.multiple == last[gain.arm] and gain.gain >= growth.gain}
