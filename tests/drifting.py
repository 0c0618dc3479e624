"""Where relative actions go wrong: a state that moves while actions wait in a queue.

State and image are functions of the tick, so a test knows from the image that the network saw which state it was.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.processor import to_absolute_actions
from torch import Tensor

from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from tests.entry_points import make_config, redraw

JOINTS = ["base.pos", "elbow.pos", "wrist.pos", "gripper.pos"]
RELATIVE = [True, True, True, False]  # the gripper stays absolute
SIZE, CHUNK, STEPS = 28, 6, 4
FRONT, STATE = "observation.images.front", "observation.state"
Q01, Q99 = torch.tensor([-0.4, -0.1, -0.3, 0.0]), torch.tensor([0.5, 0.2, 0.1, 1.0])


def state_of(tick: int) -> Tensor:
    """(4,) float32, another one at every tick below 256."""
    return torch.sin(torch.tensor([0.3, 0.7, 1.1, 0.5]) * (tick + 1)) * torch.tensor([2.0, 1.0, 1.5, 1.0])


def image_of(tick: int) -> np.ndarray:
    """(SIZE, SIZE, 3) uint8, all pixels the number of the tick."""
    return np.full((SIZE, SIZE, 3), tick, dtype=np.uint8)


def relative_config(**changes: Any):
    features = {
        FRONT: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)),
        STATE: PolicyFeature(FeatureType.STATE, (len(JOINTS),)),
    }
    settings = {
        "use_relative_actions": True,
        "action_feature_names": JOINTS,
        "geometry_source": "none",
        "input_features": features,
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (len(JOINTS),))},
        "calibration": {},
    }
    return make_config(**{**settings, **changes})


def action_stats(**changes: Any) -> dict[str, dict[str, Tensor]]:
    wide = torch.full((len(JOINTS),), 3.0)
    return {STATE: {"q01": -wide, "q99": wide}, "action": {"q01": Q01, "q99": Q99, **changes}}


def write_checkpoint(folder: Path, **changes: Any) -> Path:
    """A policy with relative actions and random weights, and its processors."""
    config = relative_config(**changes)
    policy = redraw(PI05GeometryPolicy(config))
    policy.save_pretrained(folder)
    for pipeline in make_pi05_geometry_pre_post_processors(config, action_stats()):
        pipeline.save_pretrained(folder)
    return folder


@dataclass
class Prediction:
    """One chunk as the network gave it: relative, normalised."""

    ticks: list[int]  # (B,) of the observation that it was predicted from
    chunk: Tensor  # (B, CHUNK, A)
    prefix: Tensor | None  # what real-time chunking had left over, as the network got it

    def targets(self) -> Tensor:
        """The chunk's own targets (B, CHUNK, A): LeRobot's arithmetic, with the state of the observation."""
        states = torch.stack([state_of(tick) for tick in self.ticks])
        return to_absolute_actions((self.chunk + 1) / 2 * (Q99 - Q01) + Q01, states, RELATIVE)


def record_predictions(monkeypatch: pytest.MonkeyPatch) -> list[Prediction]:
    """Every chunk that any policy predicts from now on."""
    found: list[Prediction] = []
    sample = ChunkSampler.__call__

    def recorded(self: ChunkSampler, images: list[Tensor], *observation: Any, **kwargs: Any) -> Tensor:
        chunk = sample(self, images, *observation, **kwargs)
        ticks = ((images[0][:, 0, 0, 0] + 1) / 2 * 255).round().int().tolist()
        prefix = kwargs.get("prev_chunk_left_over")
        found.append(Prediction(ticks, chunk[..., : len(JOINTS)].clone(), None if prefix is None else prefix.clone()))
        return chunk

    monkeypatch.setattr(ChunkSampler, "__call__", recorded)
    return found


class DriftingEnv(gym.Env):
    """What it was told to do stands in `received`: per episode the first tick and the actions."""

    metadata = {"render_fps": 10}  # noqa: RUF012
    task_description = "reach"
    task = "reach"
    _max_episode_steps = 7
    received: list[tuple[int, list[np.ndarray]]] = []  # noqa: RUF012

    def __init__(self) -> None:
        pixels = gym.spaces.Dict({"front": gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)})
        state = gym.spaces.Box(-9, 9, (len(JOINTS),), np.float32)
        self.observation_space = gym.spaces.Dict({"pixels": pixels, "agent_pos": state})
        self.action_space = gym.spaces.Box(-99, 99, (len(JOINTS),), np.float32)

    def _observe(self) -> dict[str, Any]:
        return {"pixels": {"front": image_of(self._tick)}, "agent_pos": state_of(self._tick).numpy()}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self._tick = 20 * (len(self.received) + 1)
        self.received.append((self._tick, []))
        self._actions = self.received[-1][1]
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self._actions.append(action.copy())
        self._tick += 1
        return self._observe(), 0.0, False, len(self._actions) >= self._max_episode_steps, {"is_success": False}

    def render(self) -> np.ndarray:
        return image_of(self._tick)


@EnvConfig.register_subclass("drifting")
@dataclass
class DriftingEnvConfig(EnvConfig):
    task: str = "reach"
    fps: int = 10
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (len(JOINTS),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(JOINTS),)),
            "pixels/front": PolicyFeature(FeatureType.VISUAL, (SIZE, SIZE, 3)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {"action": "action", "agent_pos": STATE, "pixels/front": FRONT}
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        vector = gym.vector.SyncVectorEnv([DriftingEnv] * n_envs, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP)
        return {self.type: {0: vector}}
