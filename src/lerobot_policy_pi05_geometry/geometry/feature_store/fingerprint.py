"""What tells a dataset, or one of its episodes, from a changed one, without reading its images."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow
from pyarrow import compute, parquet

from ...dataset_folder import require_dataset

# Statistics of columns that say where an episode stands in the dataset, and not what is in it.
_PLACES = ("index", "episode_index", "frame_index", "task_index", "timestamp")
_LENGTH, _EPISODE, _STATISTICS = "length", "episode_index", "stats/"
_HASH_DIGITS = 16


class Episodes(NamedTuple):
    """Episodes of a dataset in order: how many frames each has, and a hash of what its table says about it."""

    frames: list[int]
    hashes: list[str]

    def begins_with(self, other: "Episodes") -> bool:
        """Whether these are the other's episodes, and perhaps more of them."""
        count = len(other.hashes)
        return self.hashes[:count] == other.hashes and self.frames[:count] == other.frames


def read_episodes(root: Path) -> Episodes:
    """Episodes of a LeRobotDataset, from its tables meta/episodes/**/*.parquet.

    A hash is of the episode's length and its statistics, those of its images included. Its number, its task and its place in the
    files are left out, and so is everything else in `meta/`: features do not depend on them.
    Raises FileNotFoundError if there is no dataset at `root`, ValueError for a table without episodes.
    """
    require_dataset(root)
    found: dict[int, tuple[int, str]] = {}
    for path in sorted((root / "meta" / "episodes").rglob("*.parquet")):
        names = parquet.read_schema(path).names
        if not {_EPISODE, _LENGTH} <= set(names):
            raise ValueError(f"{path} is no table of episodes: it has no columns {_EPISODE} and {_LENGTH}.")
        columns = sorted(name for name in names if _describes_content(name))
        table = parquet.read_table(path, columns=[_EPISODE, *columns])
        numbers = np.concatenate([_numbers(table[name], name, path) for name in columns], axis=1)  # (episodes, N)
        prefix = hashlib.sha256(" ".join(columns).encode())
        for episode, length, row in zip(table[_EPISODE].to_pylist(), table[_LENGTH].to_pylist(), numbers, strict=True):
            digest = prefix.copy()
            digest.update(row.tobytes())
            found[episode] = (length, digest.hexdigest()[:_HASH_DIGITS])
    ordered = [found[episode] for episode in sorted(found)]
    return Episodes([frames for frames, _ in ordered], [digest for _, digest in ordered])


def _numbers(column: pyarrow.ChunkedArray, name: str, path: Path) -> np.ndarray:
    """A column of numbers, or of nested lists of them, as (rows, N) float64."""
    array = column.combine_chunks()
    while pyarrow.types.is_nested(array.type):
        lengths = compute.min_max(compute.list_value_length(array))
        if lengths["min"] != lengths["max"]:
            raise ValueError(f"{path} is no table of episodes: its column {name} has rows of different lengths.")
        array = array.flatten()
    return array.to_numpy(zero_copy_only=False).astype(np.float64).reshape(len(column), -1)


def _describes_content(column: str) -> bool:
    if column == _LENGTH:
        return True
    return column.startswith(_STATISTICS) and column.split("/")[1] not in _PLACES


def frame_files(root: Path) -> dict[str, int]:
    """The files that hold frames (data/**/*.parquet, videos/**/*.mp4), relative to `root`, and their sizes in bytes."""
    found = [*(root / "data").rglob("*.parquet"), *(root / "videos").rglob("*.mp4")]
    return {path.relative_to(root).as_posix(): path.stat().st_size for path in sorted(found)}


def changed_file(root: Path, recorded: Mapping[str, int], allow_new: bool) -> str | None:
    """The first file of frames that is not the recorded one. One that is absent, as in a partial download, is no change.

    allow_new: whether there may be files that are not recorded, as after more episodes were recorded.
    """
    for name, size in frame_files(root).items():
        if name not in recorded and allow_new:
            continue
        if recorded.get(name) != size:
            return name
    return None
