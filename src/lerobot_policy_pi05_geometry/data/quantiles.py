"""Quantiles of a dataset over all its frames.

LeRobot 0.6 keeps q01 and q99 of every episode and averages them (`datasets/compute_stats.py`). A joint or a hand that
stands elsewhere in every episode then gets a range much narrower than its own, and what lies outside is clipped before
the state is written into the prompt: the policy does not learn where the hand is.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from pyarrow import dataset as tables

WIDE_ENOUGH = 0.5  # share of min..max that q01..q99 covers, below which check_stats warns


def write_frame_quantiles(root: Path, repo_id: str = "local/dataset") -> dict[str, np.ndarray]:
    """Recompute the statistics of state and action over all frames and write them to the dataset's meta/stats.json.

    Returns, per feature, the share of min..max that q01..q99 covered before and covers now, (2, D).
    Raises FileNotFoundError if there is no dataset at `root`.
    """
    if not (Path(root) / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"{root} holds no LeRobotDataset (meta/info.json is missing).")
    meta = LeRobotDatasetMetadata(repo_id, root=root)
    stats = dict(meta.stats or {})
    table = tables.dataset(str(Path(root) / "data"), format="parquet")
    shares = {}
    for key in (OBS_STATE, ACTION):
        if key not in meta.features:
            continue
        column = table.to_table(columns=[key])[key].to_numpy()
        frames = np.stack(column).astype(np.float64).reshape(len(column), -1)  # (frames, D)
        before = stats.get(key, {})
        stats[key] = {**before, **get_feature_stats(frames, axis=0, keepdims=False)}
        shares[key] = np.stack([covered(before), covered(stats[key])]) if "q01" in before else covered(stats[key])[None]
    write_stats(stats, Path(root))
    return shares


def covered(stats: Mapping[str, Any], low_name: str = "q01", high_name: str = "q99") -> np.ndarray:
    """Share of min..max that lies between two quantiles, (D,); 1 where a dimension is constant."""
    names = (low_name, high_name, "min", "max")
    low, high, smallest, largest = (np.asarray(stats[name], dtype=np.float64) for name in names)
    spread = largest - smallest
    return np.divide(high - low, spread, out=np.ones_like(spread), where=spread > 0).reshape(-1)
