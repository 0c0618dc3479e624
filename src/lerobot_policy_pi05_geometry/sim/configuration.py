"""The environment's LeRobot configuration: `--env.type=metaworld_rgbd`."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR


@EnvConfig.register_subclass("metaworld_rgbd")
@dataclass
class MetaworldRgbdEnv(EnvConfig):
    """A Meta-World task observed by an RGB-D camera (see environment.py).

    task: of sim/tasks.py. cameras: range of camera poses, of sim/cameras.py. sensor: depth sensor, of
    sim/sensor.py. image_size: pixels per side.
    """

    task: str | None = "button-press-topdown-wide"
    fps: int = 20
    cameras: str = "train"
    sensor: str = "ideal"
    image_size: int = 84
    episode_length: int | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = self.image_size
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(4,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(4,)),
            "pixels/front": PolicyFeature(type=FeatureType.VISUAL, shape=(size, size, 3)),
            "images.front_depth": PolicyFeature(type=FeatureType.VISUAL, shape=(size, size, 1)),
            "calibration.front.extrinsics": PolicyFeature(type=FeatureType.STATE, shape=(4, 4)),
        }
        self.features_map = {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "pixels/front": f"{OBS_STR}.images.front",
            "images.front_depth": f"{OBS_STR}.images.front_depth",
            "calibration.front.extrinsics": f"{OBS_STR}.calibration.front.extrinsics",
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {
            "task": self.task,
            "cameras": self.cameras,
            "sensor": self.sensor,
            "image_size": self.image_size,
            "episode_length": self.episode_length,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        require_simulator()
        from .environment import RgbdMetaworldEnv

        make = freeze_after_episode_end(partial(RgbdMetaworldEnv, **self.gym_kwargs))
        mode = gym.vector.AutoresetMode.NEXT_STEP
        if use_async_envs and n_envs > 1:
            vector: gym.vector.VectorEnv = gym.vector.AsyncVectorEnv(
                [make] * n_envs, context="spawn", autoreset_mode=mode
            )
        else:
            vector = gym.vector.SyncVectorEnv([make] * n_envs, autoreset_mode=mode)
        return {self.type: {0: vector}}


def require_mujoco() -> None:
    """Raise ModuleNotFoundError with installation advice unless MuJoCo and an EGL library are available."""
    try:
        from . import headless  # noqa: F401

        import mujoco.gl_context  # noqa: F401  isort: skip
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"The simulated tasks need {error.name}; install them with `pip install 'lerobot_policy_pi05_geometry[sim]'`, or "
            "with `[libero]` for LIBERO's."
        ) from error
    except (ImportError, AttributeError) as error:
        raise ModuleNotFoundError(
            "MuJoCo finds no EGL library for headless rendering; install one (Debian: apt-get install libegl1)."
        ) from error


def require_simulator() -> None:
    """Raise ModuleNotFoundError with installation advice unless MuJoCo, Meta-World and an EGL library are available."""
    require_mujoco()  # first: Meta-World imports it too, and it must find its way to render without a display
    try:
        import metaworld.policies  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Meta-World's tasks need {error.name}; install them with `pip install 'lerobot_policy_pi05_geometry[sim]'`."
        ) from error
