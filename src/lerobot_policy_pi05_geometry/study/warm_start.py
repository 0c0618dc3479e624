"""Where a fine-tuning begins: a π0.5 checkpoint converted for an arm, as a user does it with `pi05-geometry convert`."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..checkpoint.conversion import GeometryStart, convert
from .locks import folder_lock

# Options that `convert` decides, since they define new weights.
_CONVERTED = ("geometry_source", "geometry_grid", "geometry_frame", "geometry_expert", "geometry_tokens")


def geometry_start(options: Mapping[str, str], views: Sequence[str]) -> GeometryStart:
    """The geometry that a checkpoint with an arm's options is converted to. views: the cameras that measure it."""
    source, grid, frame, expert, tokens = (options.get(f"policy.{name}") for name in _CONVERTED)
    return GeometryStart(
        source,
        cameras=None if source == "none" else tuple(views) or None,
        grid=None if grid is None else int(grid),
        frame=frame,
        expert=expert,
        tokens=tokens,
    )


def remaining_options(options: Mapping[str, str]) -> dict[str, str]:
    """Options of an arm that are given to lerobot-train after the conversion."""
    return {name: value for name, value in options.items() if name.removeprefix("policy.") not in _CONVERTED}


def make_start(pi05: str | Path, folder: Path, options: Mapping[str, str], views: Sequence[str], seed: int) -> None:
    """Convert a π0.5 checkpoint, a folder or hub id, for an arm with these options, unless the folder exists.

    seed: draws the new parameters.
    """
    with folder_lock(folder):
        if folder.exists():
            return
        unfinished = folder.with_name(f".{folder.name}.unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        convert(pi05, unfinished, geometry_start(options, views), features_from_data=True, seed=seed)
        unfinished.rename(folder)
