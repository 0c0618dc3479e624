"""The gymnasium environment: a Meta-World task observed by one calibrated RGB-D camera."""

from typing import Any

import gymnasium as gym
import numpy as np

from .cameras import extrinsics, find_range, intrinsics
from .renderer import RgbdRenderer
from .sensor import SENSORS
from .tasks import find_task, make_simulator

CAMERA = "front"
DEPTH_KEY = f"images.{CAMERA}_depth"
EXTRINSICS_KEY = f"calibration.{CAMERA}.extrinsics"
ACTION_REPEAT = 4  # simulator steps (1/80 s) per control step
FPS = 20
MAX_DEPTH_MM = 10_000  # larger depth counts as not measured: stored as 0
STATE_NAMES = ["hand.x", "hand.y", "hand.z", "gripper"]
ACTION_NAMES = ["hand.dx", "hand.dy", "hand.dz", "gripper"]


class RgbdMetaworldEnv(gym.Env):
    """A task whose object and camera poses are drawn from the reset seed.

    Observation: `pixels.front` (S, S, 3) uint8; `images.front_depth` (S, S, 1) float32 millimetres, 0 where not
    measured; `calibration.front.extrinsics` (4, 4) float32, base_T_camera; `agent_pos` (4,) hand position in metres and
    gripper opening. Action (4,) in [-1, 1]: hand displacement and gripper effort. An episode ends with success.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(
        self,
        task: str,
        cameras: str = "train",
        image_size: int = 84,
        episode_length: int | None = None,
        sensor: str = "ideal",
    ) -> None:
        if sensor not in SENSORS:
            raise ValueError(f"There is no depth sensor '{sensor}'; choose one of: {', '.join(SENSORS)}.")
        spec = find_task(task)
        self.task, self.task_description = task, spec.instruction
        self._spec, self._range, self.image_size = spec, find_range(cameras), image_size
        self._sensor = SENSORS[sensor]
        self._max_episode_steps = episode_length or spec.max_steps
        size = image_size
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict({CAMERA: gym.spaces.Box(0, 255, (size, size, 3), np.uint8)}),
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
                DEPTH_KEY: gym.spaces.Box(0, np.inf, (size, size, 1), np.float32),
                EXTRINSICS_KEY: gym.spaces.Box(-np.inf, np.inf, (4, 4), np.float32),
            }
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._simulator: Any = None  # built on first use, so that each worker process has its own rendering context

    def _start(self) -> None:
        simulator = make_simulator(self._spec)
        self._renderer = RgbdRenderer(simulator.model, self.image_size)
        self.calibration = {CAMERA: intrinsics(simulator.model, self.image_size)}
        self._simulator = simulator  # last, so that close() does nothing if the renderer did not start

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        if self._simulator is None:
            self._start()
        # Meta-World ignores `reset(seed=)`; its own `seed` determines the object's pose.
        self._simulator.seed(int(self.np_random.integers(2**31)))
        self._camera = self._range.draw(self.np_random)
        # Drawn last and from a separate generator: the same seed gives the same scene for every sensor.
        self._sensor_random = np.random.default_rng(int(self.np_random.integers(2**31)))
        self._pose_error = self._sensor.draw_pose_error(self._sensor_random)
        self.simulator_state, _ = self._simulator.reset()
        self._steps = 0
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        action = np.asarray(action, dtype=np.float32)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"An action must be 4 finite numbers, got {action}.")
        action = action.clip(-1.0, 1.0)
        reward, success = 0.0, False
        for _ in range(ACTION_REPEAT):
            self.simulator_state, step_reward, _, _, info = self._simulator.step(action)
            reward += float(step_reward)
            success = success or bool(info["success"])
        self._steps += 1
        truncated = not success and self._steps >= self._max_episode_steps
        return self._observe(), reward, success, truncated, {"is_success": success}

    def _observe(self) -> dict:
        self._pixels, depth = self._renderer.render(self._simulator.data, self._camera)
        millimetres = np.rint(self._sensor.measure(depth, self._sensor_random) * 1000.0)
        millimetres[millimetres > MAX_DEPTH_MM] = 0
        return {
            "pixels": {CAMERA: self._pixels},
            "agent_pos": self.simulator_state[:4].astype(np.float32),
            DEPTH_KEY: millimetres.astype(np.float32)[..., None],
            EXTRINSICS_KEY: (extrinsics(self._renderer.scene) @ self._pose_error).astype(np.float32),
        }

    def render(self) -> np.ndarray:
        """The last RGB image, enlarged four times for videos."""
        return self._pixels.repeat(4, axis=0).repeat(4, axis=1)

    def close(self) -> None:
        if self._simulator is not None:
            self._renderer.close()
            self._simulator = None
