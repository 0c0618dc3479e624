"""What tells a dataset from a changed one, without reading its images."""

import hashlib
from collections.abc import Mapping
from pathlib import Path


def dataset_hash(root: Path) -> str:
    """SHA-256 over meta/info.json and the episode tables (meta/episodes/**/*.parquet): their paths and contents.

    The episode tables say which frames are where and hold statistics of every episode's images. meta/stats.json,
    meta/tasks.parquet and a calibration are left out: features do not depend on them.
    Raises FileNotFoundError if there is no dataset at `root`.
    """
    if not (root / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"{root} holds no LeRobotDataset (meta/info.json is missing).")
    digest = hashlib.sha256()
    for path in [root / "meta" / "info.json", *sorted((root / "meta" / "episodes").rglob("*.parquet"))]:
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def frame_files(root: Path) -> dict[str, int]:
    """The files that hold frames (data/**/*.parquet, videos/**/*.mp4), relative to `root`, and their sizes in bytes."""
    found = [*(root / "data").rglob("*.parquet"), *(root / "videos").rglob("*.mp4")]
    return {path.relative_to(root).as_posix(): path.stat().st_size for path in sorted(found)}


def changed_file(root: Path, recorded: Mapping[str, int]) -> str | None:
    """The first file of frames that is not the recorded one; one that is absent, as in a partial download, is no change."""
    for name, size in frame_files(root).items():
        if recorded.get(name) != size:
            return name
    return None
