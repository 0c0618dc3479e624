"""What a study reads of a user's dataset before it trains on it."""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_END = 2**20  # bytes hashed of each end of a large file


def dataset_identity(root: Path, options: Mapping[str, str]) -> dict[str, Any]:
    """What trained policies depend on: the dataset's files, and those that lerobot-train's options name (a calibration)."""
    return {
        **{folder: _identity(root / folder) for folder in ("meta", "data", "videos")},
        **{name: _identity(Path(value)) for name, value in options.items() if os.path.exists(value)},
    }


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
