"""What a warm-start study claims about geometry, and whether its episodes support it. The thresholds were set beforehand.

1. Outside the training range of cameras, geometry succeeds at least twice as often as RGB only, and their intervals over
   training seeds and episodes are apart.
2. Inside it geometry is not worse: the 95 % lower bound of the difference is above -10 points.
3. With the depth camera off, geometry keeps at least 0.8 of RGB only's success.
4. RGB trained on the wide range, and RGB with camera rays, do not reach geometry outside. If one does, the claim becomes "learns
   faster", with the factor.

The first three are judged once more for the policy that was trained on RGB only before it got geometry, if the study has it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from .results import on_common_tasks, pooled_difference, success_matrix
from .statistics import bootstrap

RATIO, INSIDE_MARGIN, DEPTH_OFF_SHARE = 2.0, -0.10, 0.8
RIVALS = ("rgb-wide", "rgb+rays", "rgb+modulation")
GEOMETRY, AFTER_RGB = "geometry", "geometry-after-rgb"
_POLICIES = {GEOMETRY: "the policy with geometry", AFTER_RGB: "the policy that got geometry after RGB"}


@dataclass(frozen=True)
class Claim:
    """One claim. verdict: yes, no, or not tested."""

    claim: str
    verdict: str
    sentence: str


def claims(final: pd.DataFrame, every: pd.DataFrame, steps: int) -> list[Claim]:
    """Every claim against the episodes.

    final: of each arm's longest training. every: of all trainings. steps: training steps of multiple 1.
    """
    arms = [arm for arm in (GEOMETRY, AFTER_RGB) if (final["arm"] == arm).any()]
    found = [claim for arm in arms or [GEOMETRY] for claim in _of_geometry(final, arm)]
    for rival in RIVALS:
        found += _rival(final, every, rival, steps)
    return found


def _of_geometry(final: pd.DataFrame, arm: str) -> list[Claim]:
    """The claims about geometry against RGB only. arm: the arm that has geometry."""
    found = [*_outside(final, arm), *_inside(final, arm), *_depth_off(final, arm)]
    return found if arm == GEOMETRY else [replace(c, claim=f"{arm}: {c.claim}") for c in found]


def _outside(final: pd.DataFrame, arm: str) -> Iterator[Claim]:
    name = "outside the training range, at least twice RGB only's success, intervals apart"
    rows = on_common_tasks(final, (arm, "outside"), ("rgb", "outside"))
    if rows[0].empty:
        yield Claim(name, "not tested", f"The study has no task with {arm} and RGB only outside the range.")
        return
    geometry, rgb = map(_pooled, rows)
    apart = geometry[1] > rgb[2]
    holds = apart and geometry[0] >= RATIO * rgb[0]
    sentence = (
        f"With the camera outside the training range, {_POLICIES[arm]} succeeds in "
        f"{_text(geometry)} of episodes and RGB only in {_text(rgb)}."
    )
    yield Claim(name, "yes" if holds else "no", sentence)


def _inside(final: pd.DataFrame, arm: str) -> Iterator[Claim]:
    name = f"inside the training range, lower bound of the difference above {100 * INSIDE_MARGIN:.0f} points"
    rows = pd.concat(on_common_tasks(final, (arm, "inside"), ("rgb", "inside")))
    if rows.empty:
        yield Claim(name, "not tested", f"The study has no task with {arm} and RGB only inside the range.")
        return
    difference, low, high = pooled_difference(rows, arm, "rgb")
    sentence = f"Inside, {arm} minus RGB only is {_points(difference, low, high)}."
    yield Claim(name, "yes" if low > INSIDE_MARGIN else "no", sentence)


def _depth_off(final: pd.DataFrame, arm: str) -> Iterator[Claim]:
    name = f"with the depth camera off, at least {DEPTH_OFF_SHARE} of RGB only's success"
    rows = on_common_tasks(final, (arm, "depth-off"), ("rgb", "inside"))
    if rows[0].empty:
        yield Claim(name, "not tested", f"The study has no task with {arm}, its depth camera off, and RGB only.")
        return
    geometry, rgb = map(_pooled, rows)
    holds = geometry[0] >= DEPTH_OFF_SHARE * rgb[0]
    sentence = f"With the depth camera off, {arm} succeeds in {_text(geometry)}, RGB only in {_text(rgb)}."
    yield Claim(name, "yes" if holds else "no", sentence)


def _rival(final: pd.DataFrame, every: pd.DataFrame, rival: str, steps: int) -> Iterator[Claim]:
    name = f"{rival} does not reach geometry outside the training range"
    rows = pd.concat(on_common_tasks(final, ("geometry", "outside"), (rival, "outside")))
    if rows.empty:
        yield Claim(name, "not tested", f"The study has no task with geometry and {rival} outside the range.")
        return
    difference, low, high = pooled_difference(rows, "geometry", rival)
    sentence = f"Outside, geometry minus {rival} is {_points(difference, low, high)}."
    if low > 0:
        yield Claim(name, "yes", sentence)
        return
    factor = speed_factor(every, rival)
    if factor is None:
        sentence += " Geometry does not reach its success with fewer steps either."
    else:
        sentence += f" Geometry reaches its success with {steps * factor[1]:,} steps instead of {steps * factor[0]:,}"
        sentence += f": it learns {factor[0] / factor[1]:g} times as fast." if factor[0] > factor[1] else "."
    yield Claim(name, "no", sentence)


def speed_factor(every: pd.DataFrame, rival: str) -> tuple[int, int] | None:
    """The rival's largest multiple, and the smallest with which geometry has at least its success; None if none has.

    Success outside the training range, on the tasks that both have.
    """
    rows = on_common_tasks(every, ("geometry", "outside"), (rival, "outside"))
    rates = dict(zip(("geometry", rival), map(_rates, rows), strict=True))
    last = max(rates[rival])
    reached = [multiple for multiple, rate in rates["geometry"].items() if rate >= rates[rival][last]]
    return (last, min(reached)) if reached else None


def _rates(rows: pd.DataFrame) -> dict[int, float]:
    """Success per multiple, the mean over tasks."""
    by_task = rows.groupby(["multiple", "task"])["success"].mean()
    return {int(multiple): float(rate) for multiple, rate in by_task.groupby("multiple").mean().items()}


def _pooled(rows: pd.DataFrame) -> tuple[float, float, float]:
    """Success of one arm under one condition, mean over tasks, with its bootstrap interval."""
    return bootstrap(*(success_matrix(of_task).astype(np.float64) for _, of_task in rows.groupby("task")))


def _text(values: tuple[float, float, float]) -> str:
    return f"{values[0]:.0%} ({values[1]:.0%} to {values[2]:.0%})"


def _points(difference: float, low: float, high: float) -> str:
    return f"{100 * difference:+.0f} points ({100 * low:+.0f} to {100 * high:+.0f})"
