"""Conditions of an evaluation: the range of camera poses, the faults of the depth sensor, the number of denoising steps."""

import re
from dataclasses import dataclass, replace

from ..sim.cameras import azimuth_range, find_range
from .arms import DEPTH, POSE, Arm

DENOISING_STEPS = 1  # of a chunk, unless a condition says otherwise: more are worse in these tasks (docs/results.md)
_AZIMUTH = "azimuth"
_STEPS = re.compile(r"(?:(?P<condition>.+)-)?steps-(?P<count>[1-9][0-9]*)")


@dataclass(frozen=True)
class Condition:
    """One condition.

    cameras: range of camera poses (sim/cameras.py, sim/libero/cameras.py). sensor: depth sensor (sim/sensor.py).
    changes: what the sensor's fault changes, depth or the camera's pose; None for an ideal sensor.
    denoising_steps: of a chunk.
    """

    title: str
    cameras: str = "train"
    sensor: str = "ideal"
    changes: str | None = None
    denoising_steps: int = DENOISING_STEPS


CONDITIONS = {
    "inside": Condition("camera within the training range"),
    "outside": Condition("camera outside the training range", cameras="outside"),
    "fixed": Condition("the stock camera", cameras="fixed"),
    "plus": Condition("LIBERO-Plus's range of cameras", cameras="plus"),
    "far": Condition("camera far outside the training range", cameras="far"),
    "noise": Condition("depth with a structured-light sensor's noise and holes", sensor="noisy", changes=DEPTH),
    "depth-off": Condition("depth camera off", sensor="off", changes=DEPTH),
    "calibration-1": Condition("calibration wrong by 1 degree and 1 cm", sensor="calibration-1", changes=POSE),
    "calibration-2": Condition("calibration wrong by 2 degrees and 2 cm", sensor="calibration-2", changes=POSE),
    "calibration-5": Condition("calibration wrong by 5 degrees and 5 cm", sensor="calibration-5", changes=POSE),
}


def azimuth_condition(degrees: float) -> str:
    """Name of the condition with the camera at one azimuth, relative to the middle of the training range."""
    return azimuth_range(degrees)


def azimuth_of(name: str) -> float | None:
    """Azimuth of a condition of `azimuth_condition`, in degrees; None for any other condition."""
    condition, _ = split_steps(name)
    return float(condition.removeprefix(_AZIMUTH)) if condition.startswith(_AZIMUTH) else None


def split_steps(name: str) -> tuple[str, int | None]:
    """Condition and denoising steps: "steps-3" is "inside" with 3; a name without steps is itself, with None."""
    match = _STEPS.fullmatch(name)
    return (name, None) if match is None else (match["condition"] or "inside", int(match["count"]))


def _join_steps(condition: str, count: int | None) -> str:
    """The shortest name that `split_steps` reads so."""
    if count in (None, DENOISING_STEPS):
        return condition
    return f"steps-{count}" if condition == "inside" else f"{condition}-steps-{count}"


def order_of(name: str) -> tuple[int, int]:
    """Sorts conditions: those with a name of their own as they stand in CONDITIONS, then by denoising steps."""
    names = list(CONDITIONS)
    condition, steps = split_steps(name)
    return (names.index(condition) if condition in names else len(names), steps or 0)


def find_condition(name: str) -> Condition:
    """The condition of this name. Raises ValueError that lists the known names."""
    if name in CONDITIONS:
        return CONDITIONS[name]
    condition, count = split_steps(name)
    if count is not None:
        steps = f"{count} denoising step{'s' * (count > 1)}"
        found = find_condition(condition)
        return replace(found, title=f"{found.title}, {steps}", denoising_steps=count)
    if name.startswith(_AZIMUTH):
        find_range(name)
        return Condition(f"camera at {name.removeprefix(_AZIMUTH)} degrees", cameras=name)
    raise ValueError(
        f"There is no condition '{name}'; choose one of: {', '.join(CONDITIONS)}, azimuth and degrees (azimuth-30), or one of "
        "these, steps and a number of denoising steps (outside-steps-3; steps-3 is inside-steps-3)."
    )


def equivalent_condition(name: str, arm: Arm) -> str:
    """The condition to evaluate instead: a fault of what an arm does not read changes nothing for it."""
    named, count = split_steps(name)
    condition = find_condition(name)
    if condition.changes is not None and condition.changes not in arm.reads:
        named = next(n for n, c in CONDITIONS.items() if c.cameras == condition.cameras and c.changes is None)
    return _join_steps(named, count)
