"""The report of a study on a user's dataset: action error on held-out episodes, per arm, camera and step ahead."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION

from ..inspect.charts import curves_figure, horizon_figure
from ..inspect.page import Page, picture
from .arms import ARMS
from .held_out import ALL_CAMERAS, NO_DEPTH, ONLY, HeldOutRun
from .statistics import bootstrap
from .training_log import read_curve


@dataclass(frozen=True)
class ArmErrors:
    """Errors of an arm under a condition, (training seeds, episodes, S). seeds: in this order; a crashed run has no error."""

    seeds: tuple[int, ...]
    values: np.ndarray


Errors = dict[tuple[str, str], ArmErrors]  # by arm and condition


def write_held_out_report(folder: Path, runs: Sequence[HeldOutRun], command: str) -> Path:
    """Write report.html, errors.csv, errors.parquet and the pictures; returns the path of the page.

    Errors are in standard deviations of the recorded actions, averaged over action dimensions. A crashed run has no error:
    it is listed, and its arm is shown without that training seed.
    """
    errors = collect(runs)
    table = errors_table(runs)
    table.to_csv(folder / "errors.csv", index=False)
    table.to_parquet(folder / "errors.parquet", index=False)
    pictures = folder / "pictures"
    pictures.mkdir(exist_ok=True)
    page = Page(f"Does geometry help on {runs[0].dataset_root.name}?")
    page.lead(headline(errors))
    seeds, first = len({run.seed for run in runs}), runs[0]
    split = first.split
    page.text(
        f"{len(runs)} training runs of {first.training_steps} steps, {seeds} training seed{'s' if seeds > 1 else ''}; "
        f"{split.held_out} of {split.trained + split.held_out} episodes were held out, the last ones of each task. Errors are "
        "mean absolute errors of predicted action chunks, in "
        f"standard deviations of the recorded actions{_about_intervals(errors)}"
    )
    if split.untrained:
        page.text(f"Held out whole, so that no policy was trained on them: {', '.join(split.untrained)}.")
    crashed = [run.name for run in runs if run.crash.exists()]
    if crashed:
        page.text(f"Crashed runs, not in the figures: {', '.join(crashed)}.")
    page.text(
        "This is open-loop error, not success: a policy may act well along another path than the recorded one, and small "
        "errors may add up to failure. Success is measured on the robot or in a simulator."
    )
    conditions = [c for c in runs[0].conditions if any(key[1] == c for key in errors)]
    arms = [arm for arm in ARMS if (arm, ALL_CAMERAS) in errors]
    page.table(
        ["arm", "what it is", *(_title(c) for c in conditions)],
        [[arm, ARMS[arm].title, *(_interval(errors[arm, c].values.mean(axis=2)) for c in conditions)] for arm in arms],
    )
    if "geometry" in arms and len(arms) > 1:
        page.text(
            "Error of geometry minus error of each arm on the same episodes and training seeds. Negative: geometry predicts "
            "better."
        )
        rows = [[arm, *(_gap(errors, arm, c) for c in conditions)] for arm in arms if arm != "geometry"]
        page.table(["geometry minus", *(_title(c) for c in conditions)], rows)
    bands = {arm: _bands(errors[arm, ALL_CAMERAS].values) for arm in arms}
    caption = "Error by number of steps ahead: mean, and interval if there is one."
    page.row(picture(horizon_figure(bands), caption, pictures / "horizon.png"))
    curves = {
        run.arm_name: read_curve(run.log, run.log_every)
        for run in runs
        if run.seed == runs[0].seed and not run.crash.exists()
    }
    page.row(picture(curves_figure(curves), "Loss on training batches, first seed.", pictures / "curves.png"))
    page.heading("To repeat this study")
    page.code(command)
    path = folder / "report.html"
    page.write(path)
    return path


def collect(runs: Sequence[HeldOutRun]) -> Errors:
    """Errors per arm and condition. Raises ValueError if a run is neither complete nor crashed."""
    found: dict[tuple[str, str], dict[int, np.ndarray]] = {}
    for run in runs:
        if run.crash.exists():
            continue
        scale = _action_spread(run)
        for condition in run.conditions:
            errors = run.errors(condition)
            if errors is None:
                raise ValueError(
                    f"Run {run.name} has not been evaluated under '{condition}'; start the study again to complete it."
                )
            found.setdefault((run.arm_name, condition), {})[run.seed] = np.nanmean(errors / scale, axis=2)
    if not found:
        raise ValueError("Every run of the study crashed; the reason is in each run.log.")
    return {
        key: ArmErrors(tuple(by_seed), _complete_steps(np.stack(list(by_seed.values()))))
        for key, by_seed in found.items()
    }


def errors_table(runs: Sequence[HeldOutRun]) -> pd.DataFrame:
    """One row per run, condition, held-out episode, step ahead and action dimension, in the dataset's units."""
    frames = []
    for run in runs:
        for condition in run.distinct_conditions():
            errors = None if run.crash.exists() else run.errors(condition)
            if errors is not None:
                index = pd.MultiIndex.from_product(map(range, errors.shape), names=["episode", "step", "dimension"])
                of_run = pd.DataFrame({"error": errors.reshape(-1)}, index=index).reset_index()
                frames.append(of_run.assign(arm=run.arm_name, training_seed=run.seed, condition=condition))
    return pd.concat(frames, ignore_index=True)


def headline(errors: Errors) -> str:
    """The result in one sentence."""
    if ("geometry", ALL_CAMERAS) not in errors or ("rgb", ALL_CAMERAS) not in errors:
        arm, _ = min(errors, key=lambda key: errors[key].values.mean())
        return f"The arm with the smallest error on held-out episodes is {arm}."
    geometry, rgb = _paired(errors, "geometry", "rgb", ALL_CAMERAS)
    if not len(geometry):
        return "Runs crashed, and geometry and RGB only have no training seed in common, so they are not compared."
    means = f"{geometry.mean():.3f} with geometry, {rgb.mean():.3f} with RGB only"
    if geometry.shape[1] < 2:
        return f"On the one held-out episode the action error is {means}; one episode does not show which is better on others."
    gap, low, high = bootstrap(geometry - rgb)
    if low <= 0 <= high:
        verdict = "no significant difference"
    else:
        verdict = "geometry predicts better" if gap < 0 else "geometry predicts worse"
    text = f"On held-out episodes the action error is {means}: {verdict} ({gap:+.3f}, {low:+.3f} to {high:+.3f})."
    return text + (_ONE_SEED if len(geometry) == 1 else "")


def _about_intervals(errors: Errors) -> str:
    """The end of a sentence."""
    some = next(iter(errors.values())).values
    if some.shape[1] < 2:
        return "; of one held-out episode there is no interval."
    text = ", with 95 % intervals from a bootstrap over training seeds and held-out episodes."
    return text + (_ONE_SEED if len({seed for of_arm in errors.values() for seed in of_arm.seeds}) == 1 else "")


_ONE_SEED = " This is of one training seed, so the interval leaves out how much training seeds differ."


def _paired(errors: Errors, arm: str, other: str, condition: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of two arms on the training seeds that both have, (seeds, episodes) each; no seeds if there is none."""
    first, second = errors[arm, condition], errors[other, condition]
    common = [seed for seed in first.seeds if seed in second.seeds]
    of_first, of_second = (each.values[[each.seeds.index(seed) for seed in common]] for each in (first, second))
    return of_first.mean(axis=2), of_second.mean(axis=2)


def _action_spread(run: HeldOutRun) -> np.ndarray:
    """Standard deviation of every action dimension, (D,); NaN of one that never changes, in which no error is measured."""
    stats = LeRobotDatasetMetadata(run.repo_id, root=run.dataset_root).stats[ACTION]
    low, high, spread = (np.asarray(stats[name], dtype=np.float64).reshape(-1) for name in ("min", "max", "std"))
    return np.where(low == high, np.nan, spread)


def _complete_steps(errors: np.ndarray) -> np.ndarray:
    """Without steps for which some episode has no frame."""
    return errors[..., ~np.isnan(errors).any(axis=(0, 1))]


def _bands(errors: np.ndarray) -> np.ndarray:
    """Mean, low and high per step ahead, (3, S)."""
    return np.array([bootstrap(errors[..., step]) for step in range(errors.shape[2])]).T


def _interval(values: np.ndarray) -> str:
    """Mean of (training seeds, episodes), with its interval if there are several episodes."""
    mean, low, high = bootstrap(values)
    if values.shape[1] < 2:
        return f"{mean:.3f}"
    return f"{mean:.3f} ({low:.3f} to {high:.3f})"


def _gap(errors: Errors, arm: str, condition: str) -> str:
    geometry, other = _paired(errors, "geometry", arm, condition)
    if not len(geometry):
        return "no training seed in common"
    mean, low, high = bootstrap(geometry - other)
    if geometry.shape[1] < 2:
        return f"{mean:+.3f}"
    return f"{mean:+.3f} ({low:+.3f} to {high:+.3f})"


def _title(condition: str) -> str:
    if condition == NO_DEPTH:
        return "no depth"
    return "all cameras" if condition == ALL_CAMERAS else f"depth of {condition.removeprefix(ONLY)} alone"
