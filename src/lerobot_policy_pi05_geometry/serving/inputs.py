"""What a checkpoint expects of a request, and a request in either spelling of keys read into a checked observation.

```
   LeRobot          observation.images.front   observation.images.front_depth   observation.calibration.front.extrinsics
   openpi, nested   images: {front}            depth: {front}                   extrinsics: {front}
   openpi, flat     observation/front
   state            observation.state          state                            observation/state
   instruction      task                       prompt
   rig              observation.calibration.rig, or rig (rigs.py)
```

dtype and shape are checked per key, before anything is converted. Arrays are of one observation, without a batch dimension.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from lerobot.configs import RTCAttentionSchedule
from lerobot.utils.constants import OBS_STATE

from ..configuration_pi05_geometry import EMPTY_CAMERA, PI05GeometryConfig
from ..data.images import RANGE_TOLERANCE
from ..geometry.camera import CameraCalibration
from ..geometry.keys import CALIBRATION_PREFIX, DEPTH_SUFFIX, IMAGE_PREFIX, depth_key, extrinsics_key, is_geometry_key
from .limits import Limits, RequestError, shown
from .rigs import Rigs

_EXTRINSICS = ".extrinsics"
_FLOATS = ("<f4", "<f8")
_POSE = (4, 4)
_IMAGE = (0, 0, 3)  # any height and width
_NESTED = ("images", "depth", "extrinsics")
_TASKS = ("prompt", "task")
GUIDANCE_KEYS = (
    "inference_delay",
    "executed_steps",
    "execution_horizon",
    "max_guidance_weight",
    "prefix_attention_schedule",
)


@dataclass(frozen=True)
class Input:
    """One array of an observation. shape: 0 stands for any number of pixels."""

    key: str
    shape: tuple[int, ...]
    dtypes: tuple[str, ...]
    unit: str
    required: bool


class Guidance(NamedTuple):
    """Real-time chunking: how a chunk continues the session's last one. None: as the server is set up.

    inference_delay: actions that will be executed before the new chunk arrives. executed_steps: of the last chunk, when the
    observation was made.
    """

    inference_delay: int
    executed_steps: int
    execution_horizon: int | None = None
    max_guidance_weight: float | None = None
    prefix_attention_schedule: RTCAttentionSchedule | None = None


class Request(NamedTuple):
    """A checked request. observation: by LeRobot's keys; images (H, W, 3), depth (H, W), poses (4, 4), state (D,).

    rig: number of the robot's rig; None for a checkpoint of one robot.
    """

    observation: dict[str, np.ndarray]
    task: str
    guidance: Guidance | None
    noise: np.ndarray | None  # (S, max_action_dim) float32
    rig: int | None = None


class Inputs:
    """What requests to a policy may hold: under the policy's names, and under those of its training data that are none of these.

    rename_map: names of the data -> names of the policy, as its preprocessor has it. rig: the one that is served, of a checkpoint
    that has several.
    """

    def __init__(
        self,
        config: PI05GeometryConfig,
        limits: Limits,
        rename_map: Mapping[str, str] | None = None,
        rig: int | None = None,
    ) -> None:
        self._limits = limits
        self.rigs = Rigs(config, rig)
        self._noise_shape = (config.chunk_size, config.max_action_dim)
        self._chunk_size = config.chunk_size
        self.expected = {entry.key: entry for entry in _expected(config)}
        self._poses = dict(_poses_of_optional(config))
        self.trained_size = {key: tuple(feature.shape[-2:]) for key, feature in config.image_features.items()}
        renamed = {name: key for name, key in (rename_map or {}).items() if key in self.expected}
        # The policy's names, which the metadata lists, come first: with cameras swapped, the data's mean another camera.
        self._names = renamed | {name: key for key in self.expected for name in _spellings(key)}

    def read(self, message: Mapping[str, Any], seen: Iterable[str] = (), rig: int | None = None) -> Request:
        """The request in a message. seen: keys that may be missing now, since the session has sent them before: a camera fails.

        rig: of the session, if it has said so before. Raises RequestError with one sentence.
        """
        observation: dict[str, np.ndarray] = {}
        rest: dict[str, Any] = {}
        for name, value in _flat(message):
            key = self._names.get(name)
            if key is None:
                rest[name] = value
            elif key in observation:
                raise RequestError(f"The request has {key} twice, the second time as {name}.")
            else:
                observation[key] = self._array(self.expected[key], name, value)
        rig = self.rigs.take(rest, rig)
        self.rigs.require(rig)
        self._complete(observation, seen)
        task = self._task(rest)
        noise = self._noise(rest.pop("noise", None))
        guidance = self._guidance({name: rest.pop(name) for name in GUIDANCE_KEYS if name in rest})
        if rest:
            raise RequestError(
                f"The request has {shown(next(iter(rest)))}, which this policy does not know; it takes "
                f"{', '.join(self.expected)} and prompt."
            )
        return Request(observation, task, guidance, noise, rig)

    def _complete(self, observation: dict[str, np.ndarray], seen: Iterable[str]) -> None:
        """Put depth without a measurement where a camera has failed, which the policy masks.

        It also masks a camera whose depth is missing, but only if it has seen it since its last reset; another session's
        episode may have reset it.
        """
        for key, entry in self.expected.items():
            if not entry.required or key in observation:
                continue
            if entry.shape == _IMAGE or not is_geometry_key(key) or key not in seen:
                raise RequestError(f"The request has no {key}; expected {_describe(entry)}.")
            if key.startswith(CALIBRATION_PREFIX):
                depth = depth_key(key.removeprefix(CALIBRATION_PREFIX).removesuffix(_EXTRINSICS))
                known = depth in self.expected  # camera rays have none: with a pose of NaN they are masked
                observation[key] = np.eye(4, dtype=np.float32) if known else np.full((4, 4), np.nan, dtype=np.float32)
                if not known:
                    continue
                key = depth
            observation[key] = np.zeros(self.expected[key].shape, dtype=np.float32)
        for depth, pose in self._poses.items():
            if depth in observation and pose not in observation:
                if pose not in seen:
                    raise RequestError(
                        f"The request has {depth}, but not {pose}, which it needs; send both, or neither."
                    )
                del observation[depth]  # the pose has failed

    def key_of(self, name: str) -> str | None:
        """The key that a name in a request stands for; None for one that is not expected."""
        return self._names.get(name)

    def _array(self, entry: Input, name: str, value: Any) -> np.ndarray:
        if not isinstance(value, np.ndarray):
            raise RequestError(f"{name} is no array; expected {_describe(entry)}.")
        if value.dtype.str not in entry.dtypes:
            raise RequestError(f"{name} has dtype {value.dtype.str}; expected {_describe(entry)}.")
        value = _without_channel(value, entry)
        if entry.shape == _POSE and value.shape == (16,):  # as datasets store it, row by row
            value = value.reshape(_POSE)
        fits = value.ndim == len(entry.shape) and all(
            want in (0, got) for got, want in zip(value.shape, entry.shape, strict=True)
        )
        if not fits:
            raise RequestError(f"{name} has shape {value.shape}; expected {_describe(entry)}.")
        if entry.shape == _IMAGE:
            self._check_size(name, *value.shape[:2])
        if value.dtype.kind == "f" and not entry.key.endswith(DEPTH_SUFFIX):
            value = value.astype(np.float32)
            if not np.isfinite(value).all():
                raise RequestError(f"{name} holds a number that is not finite.")
            if entry.shape == _IMAGE and not -RANGE_TOLERANCE <= value.min() <= value.max() <= 1 + RANGE_TOLERANCE:
                raise RequestError(f"{name} is a float image with values outside 0 to 1; send those, or uint8.")
        return value

    def _check_size(self, name: str, height: int, width: int) -> None:
        """Refuse images of which nothing is left when they are scaled to the policy's square."""
        (low, high), ratio = self._limits.image_sides, self._limits.image_ratio
        shorter, longer = sorted((height, width))
        if shorter < low or longer > high or longer > ratio * shorter:
            raise RequestError(
                f"{name} has {height} x {width} pixels; sides must be {low} to {high}, and one at most {ratio} times the other."
            )

    def _task(self, rest: dict[str, Any]) -> str:
        given = [rest.pop(name) for name in _TASKS if name in rest]
        if len(given) != 1 or not isinstance(given[0], str):
            raise RequestError("The request must say what to do in one text, as prompt or task.")
        if len(given[0].encode()) > self._limits.text:
            raise RequestError(f"The prompt has more than {self._limits.text} bytes.")
        return given[0]

    def _noise(self, noise: Any) -> np.ndarray | None:
        if noise is None:
            return None
        fits = isinstance(noise, np.ndarray) and noise.dtype.str == "<f4" and noise.shape == self._noise_shape
        if not fits or not np.isfinite(noise).all():
            raise RequestError(f"noise must be finite float32 of shape {self._noise_shape}.")
        return noise

    def _guidance(self, given: dict[str, Any]) -> Guidance | None:
        if not given:
            return None
        for name in ("inference_delay", "executed_steps"):
            if type(given.get(name)) is not int or not 0 <= given[name] <= self._chunk_size:
                raise RequestError(f"Real-time chunking needs {name}, a whole number from 0 to {self._chunk_size}.")
        horizon, weight = given.get("execution_horizon"), given.get("max_guidance_weight")
        if horizon is not None and (type(horizon) is not int or not 1 <= horizon <= self._chunk_size):
            raise RequestError(f"execution_horizon must be a whole number from 1 to {self._chunk_size}.")
        if weight is not None and (type(weight) not in (int, float) or not 0 < weight <= 1000):
            raise RequestError("max_guidance_weight must be a number above 0 and at most 1000.")
        schedule = given.get("prefix_attention_schedule")
        if schedule is not None:
            known = {known.value.lower(): known for known in RTCAttentionSchedule}
            if not isinstance(schedule, str) or schedule.lower() not in known:
                raise RequestError(f"prefix_attention_schedule must be one of {', '.join(known)}.")
            schedule = known[schedule.lower()]
        weight = None if weight is None else float(weight)
        return Guidance(given["inference_delay"], given["executed_steps"], horizon, weight, schedule)


def _expected(config: PI05GeometryConfig) -> Iterable[Input]:
    for key, feature in config.image_features.items():
        if not key.startswith(EMPTY_CAMERA):
            height, width = feature.shape[-2:]
            unit = f"0-255, or 0-1 as float; trained with {height} x {width} pixels"
            yield Input(key, _IMAGE, ("|u1", "<f4"), unit, not config.may_be_absent(key))
    if config.geometry_source == "rgbd":
        for camera, size in config.depth_cameras().items():
            required = camera not in config.optional_depth_cameras
            yield Input(depth_key(camera), size, ("<u2", "<f4"), config.depth_unit, required)
            yield _pose(config, camera, required and config.geometry_frame == "base")
    elif config.geometry_source not in ("none", "random"):  # rays need a pose, too
        for key in config.geometry_features:
            if key.startswith(CALIBRATION_PREFIX) and key.endswith(_EXTRINSICS):
                yield _pose(config, key.removeprefix(CALIBRATION_PREFIX).removesuffix(_EXTRINSICS), True)
    state = config.robot_state_feature
    assert state is not None  # validate_features adds it
    yield Input(OBS_STATE, tuple(state.shape), _FLOATS, "as recorded, not normalised", True)


def _pose(config: PI05GeometryConfig, camera: str, needed: bool) -> Input:
    """A camera's pose, which a request must have if it is needed and the calibration does not place the camera."""
    rigs = [rig.cameras for rig in config.rigs.values()] or [config.calibration]
    placed = all(_is_placed(cameras.get(camera)) for cameras in rigs)
    unit = "base_T_camera in metres, OpenCV axes"
    return Input(extrinsics_key(camera), _POSE, _FLOATS, unit, needed and not placed)


def _poses_of_optional(config: PI05GeometryConfig) -> Iterable[tuple[str, str]]:
    """Keys of depth and pose of the cameras that a request may lack, whose pose comes with every frame."""
    if config.geometry_source == "rgbd" and config.geometry_frame == "base":
        for camera in config.optional_depth_cameras:
            if _pose(config, camera, needed=True).required:
                yield depth_key(camera), extrinsics_key(camera)


def _is_placed(camera: CameraCalibration | None) -> bool:
    return camera is None or camera.extrinsics is not None or camera.mount is not None


def _spellings(key: str) -> Iterable[str]:
    """Names of a key in requests; a slash joins the levels of nested maps."""
    yield key
    if key == OBS_STATE:
        yield from ("state", "observation/state")
        return
    short = key.removeprefix(IMAGE_PREFIX).removeprefix("observation.")
    if key.startswith(CALIBRATION_PREFIX):
        yield f"extrinsics/{key.removeprefix(CALIBRATION_PREFIX).removesuffix('.extrinsics')}"
        return
    yield from (f"images/{short}", f"observation/{short}")
    if is_geometry_key(key):
        yield f"depth/{short.removesuffix(DEPTH_SUFFIX)}"


def _flat(message: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    for name, value in message.items():
        if not isinstance(name, str):
            raise RequestError("The keys of a request must be text.")
        if name in _NESTED and isinstance(value, dict):
            for inner, entry in value.items():
                if not isinstance(inner, str):
                    raise RequestError(f"The keys in {name} must be text.")
                yield f"{name}/{inner}", entry
        else:
            yield name, value


def _without_channel(value: np.ndarray, entry: Input) -> np.ndarray:
    """Depth (H, W, 1) or (1, H, W) as (H, W); images (3, H, W) as (H, W, 3)."""
    if value.ndim != 3:
        return value
    if len(entry.shape) == 2 and entry.key.endswith(DEPTH_SUFFIX):
        if value.shape[-1] == 1:
            return value[..., 0]
        return value[0] if value.shape[0] == 1 else value
    if entry.shape == _IMAGE and value.shape[-1] != 3 and value.shape[0] == 3:
        return value.transpose(1, 2, 0)
    return value


def _describe(entry: Input) -> str:
    shape = "(H, W, 3)" if entry.shape == _IMAGE else entry.shape
    return f"{shape} of {' or '.join(entry.dtypes)}, {entry.unit}"
