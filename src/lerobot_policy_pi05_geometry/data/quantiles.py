"""Quantiles of a dataset over all its frames, and what kind of actions its statistics describe.

LeRobot 0.6 keeps q01 and q99 of every episode and averages them (`datasets/compute_stats.py`). A joint or a hand that
stands elsewhere in every episode then gets a range much narrower than its own, and what lies outside is clipped before
the state is written into the prompt: the policy does not learn where the hand is.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from pyarrow import dataset as tables

from ..dataset_folder import require_dataset

WIDE_ENOUGH = 0.5  # share of min..max that q01..q99 covers, below which check_stats warns
_LOW, _HIGH = ("q01", "q10"), ("q90", "q99")


def write_frame_quantiles(
    root: Path,
    repo_id: str = "local/dataset",
    keys: Sequence[str] = (OBS_STATE,),
    full_range: Mapping[str, Sequence[int]] | None = None,
) -> dict[str, np.ndarray]:
    """Recompute the statistics of some features over all frames and write them to the dataset's meta/stats.json.

    keys: features to recompute, with the values as they are in the frames. For actions these are absolute ones.
    full_range: dimensions of features whose quantiles become their minimum and maximum, for a dimension that hardly moves.
    Returns, per feature, the share of min..max that q01..q99 covered before and covers now, (2, D).
    Raises FileNotFoundError if there is no dataset at `root`, ValueError if its action statistics are of relative actions
    and `keys` names actions, a frame has a value that is not finite, or `full_range` names what is not there. Then nothing is
    written.
    """
    root = Path(root)
    meta = LeRobotDatasetMetadata(repo_id, root=require_dataset(root))
    if ACTION in keys and action_kind(meta) == "relative":
        raise ValueError(
            f"The action statistics of {root} are of relative actions (use_relative_actions), computed over whole chunks; "
            "leave them as they are, or first make them absolute again with `lerobot-edit-dataset --operation.type "
            "recompute_stats`."
        )
    stats = dict(meta.stats or {})
    before = {key: stats[key] for key in (*keys, *(full_range or {})) if key in stats}
    table = tables.dataset(str(root / "data"), format="parquet")
    changed = []
    for key in keys:
        if key in meta.features:
            column = table.to_table(columns=[key])[key].to_numpy()
            frames = np.stack(column).astype(np.float64).reshape(len(column), -1)  # (frames, D)
            _require_finite(key, frames)
            stats[key] = {**stats.get(key, {}), **_frame_stats(frames)}
            changed.append(key)
    for key, dims in (full_range or {}).items():
        stats[key] = _with_full_range(key, stats, dims)
        changed.append(key)
    write_stats(stats, root)
    return {
        key: np.stack([covered(before[key]), covered(stats[key])])
        if "q01" in before.get(key, {})
        else covered(stats[key])[None]
        for key in dict.fromkeys(changed)
    }


def _require_finite(key: str, frames: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(frames))
    if len(bad):
        frame, dim = bad[0]
        raise ValueError(
            f"{key}[{dim}] is {frames[frame, dim]} in frame {frame}, so it has no quantiles; correct the frame or leave out its "
            "episode (`lerobot-edit-dataset`). The statistics stay as they are."
        )


def _frame_stats(frames: np.ndarray) -> dict[str, np.ndarray]:
    """LeRobot's statistics of (frames, D); of a constant dimension all quantiles are the constant, without rounding."""
    found = get_feature_stats(frames, axis=0, keepdims=False)
    constant = found["min"] == found["max"]
    return {
        name: np.where(constant, found["min"], value) if name.startswith("q") else value
        for name, value in found.items()
    }


def _with_full_range(key: str, stats: Mapping[str, Mapping[str, Any]], dims: Sequence[int]) -> dict[str, Any]:
    """The statistics of a feature, in some dimensions with the minimum as low and the maximum as high quantiles."""
    found = {name: np.array(value, dtype=np.float64) for name, value in stats.get(key, {}).items()}
    missing = sorted({"min", "max", "q01", "q99"} - set(found))
    if missing:
        raise ValueError(
            f"{key} has no {'/'.join(missing)} statistics, so its range cannot be set; compute them first."
        )
    width = len(found["min"])
    for dim in dims:
        if not 0 <= dim < width:
            raise ValueError(f"{key} has dimensions 0 to {width - 1}, so {key}:{dim} is none of them.")
        for names, source in ((_LOW, "min"), (_HIGH, "max")):
            for name in names:
                if name in found:
                    found[name][dim] = found[source][dim]
    return found


def action_kind(meta: Any) -> Literal["absolute", "relative"] | None:
    """Whether a dataset's action statistics are of absolute or of relative actions; None if that cannot be told.

    Recorded actions are absolute. So statistics whose minimum and maximum are those of the recorded actions are absolute.
    """
    stats = (getattr(meta, "stats", None) or {}).get(ACTION, {})
    recorded = _range_of_actions(Path(meta.root)) if {"min", "max"} <= set(stats) else None
    if recorded is None:
        return None
    low, high = recorded
    given_low, given_high = (np.asarray(stats[name], dtype=np.float64).reshape(-1) for name in ("min", "max"))
    if given_low.shape != low.shape:
        return None
    tolerance = 1e-3 * (high - low) + 1e-6
    same = (np.abs(given_low - low) <= tolerance) & (np.abs(given_high - high) <= tolerance)
    return "absolute" if same.all() else "relative"


def _range_of_actions(root: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Smallest and largest recorded action, (D,) each: of all frames, or by the episodes' statistics if the data are streamed.

    The frames decide where they are: LeRobot's `recompute_stats` leaves the statistics of the episodes as they were.
    """
    for folder, columns in (
        (root / "data", (ACTION, ACTION)),
        (root / "meta" / "episodes", (f"stats/{ACTION}/min", f"stats/{ACTION}/max")),
    ):
        table = tables.dataset(str(folder), format="parquet") if folder.is_dir() else None
        if table is not None and set(columns) <= set(table.schema.names):
            rows = [
                [np.stack(batch[name].to_numpy(zero_copy_only=False)) for name in columns]  # (rows, D) each
                for batch in table.to_batches(columns=list(dict.fromkeys(columns)))
                if len(batch)
            ]
            lows, highs = (
                np.concatenate([r.reshape(len(r), -1) for r in of_name]) for of_name in zip(*rows, strict=True)
            )
            # Training names a frame that is no number; here it says nothing.
            known = np.isfinite(lows).all(axis=1) & np.isfinite(highs).all(axis=1)
            return (lows[known].min(axis=0), highs[known].max(axis=0)) if known.any() else None
    return None


def covered(stats: Mapping[str, Any], low_name: str = "q01", high_name: str = "q99") -> np.ndarray:
    """Share of min..max that lies between two quantiles, (D,); 1 where a dimension is constant."""
    names = (low_name, high_name, "min", "max")
    low, high, smallest, largest = (np.asarray(stats[name], dtype=np.float64) for name in names)
    spread = largest - smallest
    return np.divide(high - low, spread, out=np.ones_like(spread), where=spread > 0).reshape(-1)
