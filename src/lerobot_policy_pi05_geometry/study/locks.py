"""Locks between processes that share an output folder."""

from pathlib import Path

from filelock import FileLock


def folder_lock(folder: Path) -> FileLock:
    """A lock for creating a folder, to be used in a `with`. The lock file stands beside it; a killed process releases it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(folder.with_name(f".{folder.name}.lock"))
