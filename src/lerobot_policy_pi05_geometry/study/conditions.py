"""Conditions under which a trained policy is evaluated: where the camera stands, and what its depth is worth."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Condition:
    """One condition: a range of camera poses (sim/cameras.py) and a depth sensor (sim/sensor.py)."""

    title: str
    cameras: str = "train"
    sensor: str = "ideal"


CONDITIONS = {
    "inside": Condition("camera within the training range"),
    "outside": Condition("camera outside the training range", cameras="outside"),
    "far": Condition("camera far outside the training range", cameras="far"),
    "noise": Condition("depth with a real sensor's noise and holes", sensor="noisy"),
    "depth-off": Condition("depth camera off", sensor="off"),
    "calibration-1": Condition("calibration wrong by 1 degree and 1 cm", sensor="calibration-1"),
    "calibration-2": Condition("calibration wrong by 2 degrees and 2 cm", sensor="calibration-2"),
    "calibration-5": Condition("calibration wrong by 5 degrees and 5 cm", sensor="calibration-5"),
}


def find_condition(name: str) -> Condition:
    """The condition of this name. Raises ValueError with the names there are."""
    if name not in CONDITIONS:
        raise ValueError(f"There is no condition '{name}'; choose of: {', '.join(CONDITIONS)}.")
    return CONDITIONS[name]


def counts_as(name: str, depth: bool) -> str:
    """The condition whose episodes stand for this one: without depth, a depth sensor's faults change nothing."""
    condition = find_condition(name)
    if depth or condition.sensor == "ideal":
        return name
    return next(n for n, c in CONDITIONS.items() if c.cameras == condition.cameras and c.sensor == "ideal")
