"""The environment's LeRobot configuration: `--env.type=libero_rgbd`. Importing this imports nothing of LIBERO."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR


@EnvConfig.register_subclass("libero_rgbd")
@dataclass
class LiberoRgbdEnv(EnvConfig):
    """LIBERO tasks observed by calibrated RGB-D cameras (see environment.py).

    task: suites, separated by commas. task_ids: of every suite; None is all. cameras: range of front camera poses, of
    cameras.py. placement: where objects stand, of tasks.py. views: cameras that are observed. image_size: pixels per side.
    rendering: `full` as LeRobot's LIBERO, `fast` without shadows and multisampling. sensor: depth sensor, of
    sim/sensor.py. state_frame: of the hand's position, `base` (the Panda's) or `world`, as public checkpoints have it.
    """

    task: str | None = "libero_spatial"
    task_ids: list[int] | None = None
    fps: int = 20
    cameras: str = "fixed"
    placement: str = "stock"
    views: list[str] = field(default_factory=lambda: ["front", "wrist"])
    image_size: int = 256
    rendering: str = "full"
    sensor: str = "ideal"
    state_frame: str = "base"
    episode_length: int | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = self.image_size
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(7,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        for name in self.views:
            for key, kind, shape in (
                (f"pixels/{name}", FeatureType.VISUAL, (size, size, 3)),
                (f"images.{name}_depth", FeatureType.VISUAL, (size, size, 1)),
                (f"calibration.{name}.extrinsics", FeatureType.STATE, (4, 4)),
            ):
                self.features[key] = PolicyFeature(type=kind, shape=shape)
                self.features_map[key] = f"{OBS_STR}.{key.replace('pixels/', 'images.')}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        names = ("cameras", "placement", "image_size", "rendering", "sensor", "state_frame", "episode_length")
        return {"views": tuple(self.views), **{name: getattr(self, name) for name in names}}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """Vector environments by suite and task number. Asynchronous ones start with their first reset."""
        from .environment import RgbdLiberoEnv
        from .tasks import suite_tasks

        suites = [name.strip() for name in (self.task or "").split(",") if name.strip()]
        if not suites:
            raise ValueError("--env.task must name a LIBERO suite, such as libero_spatial.")
        built: dict[str, dict[int, Any]] = {}
        for suite in suites:
            numbers = range(len(suite_tasks(suite))) if self.task_ids is None else self.task_ids
            built[suite] = {}
            for number in numbers:
                make = partial(RgbdLiberoEnv, suite, number, **self.gym_kwargs)
                if use_async_envs and n_envs > 1:
                    built[suite][number] = _LazyAsyncVectorEnv([make] * n_envs)  # it freezes ended episodes itself
                else:
                    makers = [freeze_after_episode_end(make)] * n_envs
                    mode = gym.vector.AutoresetMode.NEXT_STEP
                    built[suite][number] = gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
        return built
