"""One process at a time on what several may want to make."""

from pathlib import Path

from filelock import FileLock


def alone(folder: Path) -> FileLock:
    """A lock for making a folder, to be used in a `with`; it lies beside the folder and ends with its process."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(folder.with_name(f".{folder.name}.lock"))
