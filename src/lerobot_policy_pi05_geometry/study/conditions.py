"""Conditions of an evaluation: the range of camera poses and the faults of the depth sensor."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Condition:
    """One condition. cameras: range of camera poses (sim/cameras.py). sensor: depth sensor (sim/sensor.py)."""

    title: str
    cameras: str = "train"
    sensor: str = "ideal"


CONDITIONS = {
    "inside": Condition("camera within the training range"),
    "outside": Condition("camera outside the training range", cameras="outside"),
    "far": Condition("camera far outside the training range", cameras="far"),
    "noise": Condition("depth with a structured-light sensor's noise and holes", sensor="noisy"),
    "depth-off": Condition("depth camera off", sensor="off"),
    "calibration-1": Condition("calibration wrong by 1 degree and 1 cm", sensor="calibration-1"),
    "calibration-2": Condition("calibration wrong by 2 degrees and 2 cm", sensor="calibration-2"),
    "calibration-5": Condition("calibration wrong by 5 degrees and 5 cm", sensor="calibration-5"),
}


def find_condition(name: str) -> Condition:
    """The condition of this name. Raises ValueError that lists the known names."""
    if name not in CONDITIONS:
        raise ValueError(f"There is no condition '{name}'; choose one of: {', '.join(CONDITIONS)}.")
    return CONDITIONS[name]


def equivalent_condition(name: str, depth: bool) -> str:
    """The condition to evaluate instead: an arm without depth observes the same under every depth sensor."""
    condition = find_condition(name)
    if depth or condition.sensor == "ideal":
        return name
    return next(n for n, c in CONDITIONS.items() if c.cameras == condition.cameras and c.sensor == "ideal")
