"""The gymnasium environment: a LIBERO task observed by its calibrated front and wrist camera."""

import zlib

import gymnasium as gym
import numpy as np

from ..environment import MAX_DEPTH_MM
from ..sensor import SENSORS
from .cameras import find_range
from .rendering import CAMERAS, RENDERINGS, Frame
from .scene import FPS, LiberoScene
from .tasks import PLACEMENTS, LiberoTask, find_task

STATE_NAMES = ["hand.x", "hand.y", "hand.z", "hand.rx", "hand.ry", "hand.rz", "finger.left", "finger.right"]
ACTION_NAMES = ["hand.dx", "hand.dy", "hand.dz", "hand.drx", "hand.dry", "hand.drz", "gripper"]
STATE_FRAMES = ("base", "world")


def depth_key(camera: str) -> str:
    return f"images.{camera}_depth"


def extrinsics_key(camera: str) -> str:
    return f"calibration.{camera}.extrinsics"


def axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """Quaternion (x, y, z, w) -> rotation vector, (3,), as LeRobot's and OpenVLA's LIBERO states have it.

    Its angle is in [0, 2 pi]: near a half turn, where the hand points down, the shorter one would jump between signs.
    """
    w = np.clip(quaternion[3], -1.0, 1.0)
    sine = np.sqrt(1.0 - w * w)
    return np.zeros(3) if sine < 1e-10 else quaternion[:3] * (2.0 * np.arccos(w) / sine)


def public_orientation(pixels: np.ndarray) -> np.ndarray:
    """An upright image -> how public LIBERO data and checkpoints have it: mirrored.

    LeRobot turns robosuite's image by flipping rows and columns; the image's first row is the bottom one, so the rows
    come out upright and the columns mirrored. No rigid camera pose describes that, so depth is not mirrored.
    """
    return np.ascontiguousarray(pixels[:, ::-1])


class RgbdLiberoEnv(gym.Env):
    """A LIBERO task. Layout and camera pose are drawn from the reset seed.

    Observation, for each camera of `views`: `pixels.<cam>` (S, S, 3) uint8, oriented as in public LIBERO data;
    `images.<cam>_depth` (S, S, 1) float32 millimetres, upright, 0 where not measured; `calibration.<cam>.extrinsics`
    (4, 4) float32, base_T_camera. `agent_pos` (8,): hand position in metres, rotation vector, both fingers' positions.
    Action (7,) in [-1, 1], LIBERO's own: displacement, rotation, gripper (1 closes). An episode ends with success.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(
        self,
        suite: str,
        task_id: int,
        cameras: str = "fixed",
        placement: str = "stock",
        views: tuple[str, ...] = tuple(CAMERAS),
        image_size: int = 256,
        rendering: str = "full",
        sensor: str = "ideal",
        state_frame: str = "base",
        episode_length: int | None = None,
    ) -> None:
        self._range = find_range(cameras)
        for value, known, what in (
            (placement, PLACEMENTS, "placement"),
            (sensor, SENSORS, "depth sensor"),
            (rendering, RENDERINGS, "rendering"),
            (state_frame, STATE_FRAMES, "state frame"),
        ):
            if value not in known:
                raise ValueError(f"There is no {what} '{value}'; choose one of: {', '.join(known)}.")
        unknown = sorted(set(views) - set(CAMERAS))
        if unknown or not views:
            raise ValueError(
                f"views must name some of the cameras {', '.join(CAMERAS)}; got {', '.join(views) or 'none'}."
            )
        self.libero_task: LiberoTask = find_task(suite, task_id)
        self.task, self.task_description = self.libero_task.name, self.libero_task.instruction
        self.placement, self.views, self.image_size, self._rendering = placement, tuple(views), image_size, rendering
        self._sensor, self._state_frame = SENSORS[sensor], state_frame
        self._max_episode_steps = episode_length or self.libero_task.max_steps
        size = image_size
        spaces: dict[str, gym.Space] = {
            "pixels": gym.spaces.Dict({name: gym.spaces.Box(0, 255, (size, size, 3), np.uint8) for name in views}),
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (8,), np.float32),
        }
        for name in views:
            spaces[depth_key(name)] = gym.spaces.Box(0, np.inf, (size, size, 1), np.float32)
            spaces[extrinsics_key(name)] = gym.spaces.Box(-np.inf, np.inf, (4, 4), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (7,), np.float32)
        self.scene: LiberoScene | None = None  # built on first use: each worker process has its own rendering context

    @property
    def calibration(self) -> dict:
        """Intrinsics of the cameras of `views`; their poses come with every frame. Known after the first reset."""
        scene = self._started()
        return {name: scene.rig.calibration[name] for name in self.views} if scene.rig else {}

    def _started(self) -> LiberoScene:
        if self.scene is None:
            with_depth = self._sensor.on
            self.scene = LiberoScene(self.libero_task, self.image_size, self.views, self._rendering, with_depth)
        return self.scene

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        scene = self._started()
        # One generator per purpose: the same seed gives the same layout for every camera range and every sensor.
        move = self._range.draw(np.random.default_rng([seed, zlib.crc32(b"camera")]))
        self._sensor_random = np.random.default_rng([seed, zlib.crc32(b"sensor")])
        self._pose_error = self._sensor.draw_pose_error(self._sensor_random)
        observation = scene.reset(seed, self.placement, move)
        self._steps = 0
        return self._observe(observation), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (7,) or not np.isfinite(action).all():
            raise ValueError(f"An action must be 7 finite numbers, got {action}.")
        observation, success = self._started().step(action.clip(-1.0, 1.0))
        self._steps += 1
        truncated = not success and self._steps >= self._max_episode_steps
        return self._observe(observation), float(success), success, truncated, {"is_success": success}

    def _observe(self, observation: dict) -> dict:
        scene = self._started()
        self.state = hand_state(observation, scene.base if self._state_frame == "base" else np.zeros(3))
        self.frames = scene.frames
        return {
            "pixels": {name: public_orientation(scene.frames[name].pixels) for name in self.views},
            "agent_pos": self.state,
            **{depth_key(name): self._measure(scene.frames[name]) for name in self.views},
            **{
                extrinsics_key(name): (scene.frames[name].extrinsics @ self._pose_error).astype(np.float32)
                for name in self.views
            },
        }

    def _measure(self, frame: Frame) -> np.ndarray:
        millimetres = np.rint(self._sensor.measure(frame.depth, self._sensor_random) * 1000.0)
        millimetres[millimetres > MAX_DEPTH_MM] = 0
        return millimetres.astype(np.float32)[..., None]

    def render(self) -> np.ndarray:
        """The last RGB images, upright, side by side."""
        return np.concatenate([self.frames[name].pixels for name in self.views], axis=1)

    def close(self) -> None:
        if self.scene is not None:
            self.scene.close()
            self.scene = None


def hand_state(observation: dict, origin: np.ndarray) -> np.ndarray:
    """LIBERO's state, (8,) float32, with the hand's position relative to `origin` (world frame, metres)."""
    parts = (
        observation["robot0_eef_pos"] - origin,
        axis_angle(observation["robot0_eef_quat"]),
        observation["robot0_gripper_qpos"],
    )
    return np.concatenate(parts).astype(np.float32)
