"""What a study reads of a user's dataset before it trains on it."""

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.keys import camera_of, depth_features, select_cameras
from ..planner.options import configuration

_END = 2**20  # bytes hashed of each end of a large file


def dataset_identity(root: Path, options: Mapping[str, str]) -> dict[str, Any]:
    """What trained policies depend on: the dataset's files, and those that lerobot-train's options name (a calibration)."""
    return {
        **{folder: _identity(root / folder) for folder in ("meta", "data", "videos")},
        **{name: _identity(Path(value)) for name, value in options.items() if os.path.exists(value)},
    }


@dataclass(frozen=True)
class Split:
    """Numbers of episodes to train on and held out; untrained: tasks of which every episode is held out."""

    trained: int
    held_out: int
    untrained: tuple[str, ...]


def split_episodes(root: Path, repo_id: str, share: float, options: Mapping[str, str]) -> Split:
    """How LeRobot divides a dataset: of each task it holds out the last episodes, their share rounded up.

    options: of lerobot-train; `dataset.episodes` are those that it reads. Raises ValueError if none is left to train on.
    """
    tasks = list(LeRobotDatasetMetadata(repo_id, root=root).episodes["tasks"])
    chosen = json.loads(options.get("dataset.episodes", "null"))
    of_task = Counter(
        tasks[episode][0] if tasks[episode] else "" for episode in (range(len(tasks)) if chosen is None else chosen)
    )
    held_out = {task: math.ceil(count * share) for task, count in of_task.items()}
    trained = of_task.total() - sum(held_out.values())
    if trained == 0:
        raise ValueError(
            f"Of the {of_task.total()} episodes in {root} none is left to train on: the last ones of each task are held out, "
            f"{share:.0%} of them rounded up; record more of each task, or give a smaller --held-out."
        )
    return Split(trained, sum(held_out.values()), tuple(task for task in of_task if held_out[task] == of_task[task]))


def depth_cameras(root: Path, repo_id: str, options: Mapping[str, str]) -> list[str]:
    """The cameras whose depth a policy reads: those of --policy.geometry_cameras, or all of the dataset, sorted by name.

    options: of lerobot-train, without the dashes. Raises ValueError if the dataset has depth, but not of a wanted camera.
    """
    settings, features = _camera_settings(options), LeRobotDatasetMetadata(repo_id, root=root).features
    found = depth_features(features, settings.depth_keys)
    return list(select_cameras(found, settings.geometry_cameras if found else None, "depth"))


def geometry_cameras(root: Path, repo_id: str, options: Mapping[str, str]) -> list[str]:
    """The cameras that geometry comes from with an arm's options: with depth, or for rays with RGB images."""
    settings, features = _camera_settings(options), LeRobotDatasetMetadata(repo_id, root=root).features
    if options.get("policy.geometry_source") != "rays":
        return depth_cameras(root, repo_id, options)
    depth = depth_features(features, settings.depth_keys).values()
    images = [key for key, feature in features.items() if feature["dtype"] in ("image", "video") and key not in depth]
    return list(select_cameras({camera_of(key): key for key in images}, settings.geometry_cameras, "RGB images"))


def _camera_settings(options: Mapping[str, str]) -> PI05GeometryConfig:
    """A configuration with those of the options that choose cameras."""
    return configuration(
        {n: options[f"policy.{n}"] for n in ("depth_keys", "geometry_cameras") if f"policy.{n}" in options}
    )


def _identity(path: Path) -> list[Any]:
    """Names, sizes and hashes of a file or of a folder's files; the time of writing does not count.

    Of a large file only both ends are hashed: Parquet and MP4 files keep an index of their content there.
    """
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return [(file.relative_to(path).as_posix(), file.stat().st_size, _hash(file)) for file in files]


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        content = file.read(_END)
        file.seek(max(file.tell(), path.stat().st_size - _END))
        return hashlib.sha256(content + file.read()).hexdigest()
