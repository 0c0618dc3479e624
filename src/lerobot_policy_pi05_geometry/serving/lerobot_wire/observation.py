"""What a robot_client says of its robot, and an observation of it -> a request under LeRobot's keys."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from lerobot.utils.constants import OBS_STATE

from ...geometry.keys import IMAGE_PREFIX
from ..inputs import Inputs
from ..limits import RequestError, shown
from .pickles import Array, Instance

_MAX_NAMES = 1024


class Robot(NamedTuple):
    """joints: names of the numbers that are the state, in order. cameras: the policy's key -> the robot's name of its images.

    actions: how many of a chunk the robot wants.
    """

    joints: list[str]
    cameras: dict[str, str]
    actions: int


class Observation(NamedTuple):
    """An observation, when it was made (the client's clock, seconds), and at which step of the episode."""

    message: dict[str, Any]
    timestamp: float
    timestep: int
    must_go: bool


def read_robot(told: Any, inputs: Inputs, chunk_size: int) -> Robot:
    """The robot in a client's policy instructions. Which policy it names, and from where, is not looked at.

    Raises RequestError with one sentence, also for a robot that does not fit the policy.
    """
    if type(told) is not Instance or told.name != "RemotePolicyConfig":
        raise RequestError("Expected the policy instructions of a robot_client.")
    features, actions = told.fields.get("lerobot_features"), told.fields.get("actions_per_chunk")
    if type(features) is not dict:
        raise RequestError("The policy instructions do not say what the robot observes.")
    if type(actions) is not int or actions < 1:
        raise RequestError("actions_per_chunk must be a whole number from 1 on.")
    names = features.get(OBS_STATE)
    joints = names.get("names") if type(names) is dict else None
    if type(joints) is not list or len(joints) > _MAX_NAMES or not all(type(name) is str for name in joints):
        raise RequestError("The policy instructions do not name the robot's joints.")
    expected = inputs.expected[OBS_STATE].shape[0]
    if len(joints) != expected:
        raise RequestError(f"The robot has {len(joints)} numbers of state, but the policy was trained with {expected}.")
    names_of_cameras = [key for key in features if key.startswith(IMAGE_PREFIX)]
    # A camera that the policy does not know is left out, as LeRobot's own server does.
    cameras = {key: name.removeprefix(IMAGE_PREFIX) for name in names_of_cameras if (key := inputs.key_of(name))}
    missing = [key for key, entry in inputs.expected.items() if entry.required and key not in (*cameras, OBS_STATE)]
    if missing:
        have = ", ".join(map(shown, names_of_cameras[:8])) or "no camera"
        raise RequestError(f"The policy needs {', '.join(missing)}, but the robot has {have}.")
    return Robot(joints, cameras, min(actions, chunk_size))


def read_observation(told: Any, robot: Robot) -> Observation:
    """An observation of that robot. Raises RequestError with one sentence."""
    if type(told) is not Instance or told.name != "TimedObservation":
        raise RequestError("Expected an observation of a robot_client.")
    raw, when, step = (told.fields.get(name) for name in ("observation", "timestamp", "timestep"))
    if type(raw) is not dict or type(when) is not float or type(step) is not int or not 0 <= step < 2**53:
        raise RequestError("The observation has no values, time or step.")
    message: dict[str, Any] = {OBS_STATE: np.array([_number(raw, name) for name in robot.joints], dtype=np.float32)}
    for key, name in robot.cameras.items():
        if name in raw:
            message[key] = _array(raw, name)
    return Observation(message | {"task": raw.get("task", "")}, when, step, told.fields.get("must_go") is True)


def _number(raw: Mapping[str, Any], name: str) -> float:
    value = raw.get(name)
    if type(value) is Array and value.value is not None and value.value.size == 1:
        return float(value.value.item())
    if type(value) not in (float, int, bool) or not abs(value) < 1e30:  # type: ignore[arg-type]
        raise RequestError(f"The observation has no number {shown(name)}.")
    return float(value)  # type: ignore[arg-type]


def _array(raw: Mapping[str, Any], name: str) -> np.ndarray:
    value = raw[name]
    if type(value) is not Array or value.value is None:
        raise RequestError(f"The observation's {shown(name)} is no image.")
    return value.value
