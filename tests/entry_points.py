"""Small policies, batches and processors for the tests of LeRobot's entry points."""

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.geometry import CameraCalibration
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
FRONT_DEPTH, WRIST_DEPTH = f"{FRONT}_depth", f"{WRIST}_depth"
WRIST_POSE = "observation.calibration.wrist.extrinsics"
STATE, TOKENS, TOKEN_MASK = "observation.state", "observation.language.tokens", "observation.language.attention_mask"
GEOMETRY = (FRONT_DEPTH, WRIST_DEPTH, WRIST_POSE)
STATE_DIM, ACTION_DIM, CHUNK = 7, 5, 6


def make_features() -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """Inputs and outputs as LeRobot types them: two RGB-D cameras, the second with a pose in every frame."""
    inputs = {
        FRONT: PolicyFeature(FeatureType.VISUAL, (3, 30, 40)),
        WRIST: PolicyFeature(FeatureType.VISUAL, (3, 28, 28)),
        WRIST_DEPTH: PolicyFeature(FeatureType.VISUAL, (1, 12, 12)),
        FRONT_DEPTH: PolicyFeature(FeatureType.VISUAL, (1, 18, 24)),
        WRIST_POSE: PolicyFeature(FeatureType.STATE, (4, 4)),
        STATE: PolicyFeature(FeatureType.STATE, (STATE_DIM,)),
    }
    return inputs, {"action": PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))}


def make_calibration() -> dict[str, CameraCalibration]:
    pose = [[0.0, -0.6, 0.8, -0.5], [-1.0, 0.0, 0.0, 0.1], [0.0, -0.8, -0.6, 0.7], [0.0, 0.0, 0.0, 1.0]]
    return {
        "front": CameraCalibration([30.0, 30.0, 19.5, 14.5], [40, 30], pose),
        "wrist": CameraCalibration([12.0, 12.0, 5.5, 5.5], [12, 12]),
    }


def make_config(**changes: Any) -> PI05GeometryConfig:
    """A configuration of the `tiny` size with the features of `make_features`."""
    inputs, outputs = make_features()
    settings = {
        "device": "cpu",
        "paligemma_variant": "tiny",
        "action_expert_variant": "tiny",
        "image_resolution": (28, 28),
        "chunk_size": CHUNK,
        "n_action_steps": 4,
        "max_action_dim": 8,
        "num_inference_steps": 3,
        "geometry_grid": 3,
        "calibration": make_calibration(),
        "input_features": inputs,
        "output_features": outputs,
        "push_to_hub": False,
    }
    return PI05GeometryConfig(**{**settings, **changes})


@torch.no_grad()
def redraw(policy: PI05GeometryPolicy, seed: int = 0) -> PI05GeometryPolicy:
    """Draw every parameter at random: the zeros and ones of a new network hide errors."""
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in policy.named_parameters():
        drawn = 0.15 * torch.randn(parameter.shape, generator=generator)
        parameter.copy_(drawn.exp() if name.endswith(".openness") else drawn)
    return policy


def make_policy(seed: int = 0, **changes: Any) -> PI05GeometryPolicy:
    """A policy of `make_config` with random parameters, in evaluation mode."""
    torch.manual_seed(seed)
    return redraw(PI05GeometryPolicy(make_config(**changes)), seed).eval()


def make_observation(size: int = 2, seed: int = 0) -> dict[str, Any]:
    """A raw observation batch with a task; depth in millimetres, state in [-1, 1]."""
    random = torch.Generator().manual_seed(seed)

    def depth(height: int, width: int) -> Tensor:
        millimetres = 300 + 1500 * torch.rand(size, 1, height, width, generator=random)
        return millimetres.where(torch.rand(millimetres.shape, generator=random) > 0.2, 0.0).round()

    pose = torch.eye(4).repeat(size, 1, 1)
    pose[:, :3, 3] = torch.rand(size, 3, generator=random)
    return {
        FRONT: torch.rand(size, 3, 30, 40, generator=random),
        WRIST: torch.rand(size, 3, 28, 28, generator=random),
        FRONT_DEPTH: depth(18, 24),
        WRIST_DEPTH: depth(12, 12),
        WRIST_POSE: pose,
        STATE: 2 * torch.rand(size, STATE_DIM, generator=random) - 1,
        "task": ["press the button", "open the door and then close it"][:size] + ["push"] * (size - 2),
    }


def make_batch(size: int = 2, seed: int = 0) -> dict[str, Any]:
    """A batch as the preprocessor returns it, with actions; prompts of several lengths."""
    random = torch.Generator().manual_seed(seed + 1)
    lengths = 3 + torch.arange(size) % 3
    return make_observation(size, seed) | {
        TOKENS: torch.randint(0, 1024, (size, 5), generator=random),
        TOKEN_MASK: torch.arange(5)[None] < lengths[:, None],
        "action": torch.randn(size, CHUNK, ACTION_DIM, generator=random),
        "index": torch.randint(0, 10_000, (size,), generator=random),
    }


def make_stats() -> dict[str, dict[str, Tensor]]:
    """Dataset statistics that do not change a state in [-1, 1], and scale actions."""
    spread = torch.linspace(1.0, 2.0, ACTION_DIM)
    return {
        STATE: {"q01": -torch.ones(STATE_DIM), "q99": torch.ones(STATE_DIM)},
        "action": {"q01": -spread, "q99": 2 * spread},
    }


def make_processors(config: PI05GeometryConfig):
    """Pre- and postprocessor of a configuration whose features were validated, as LeRobot does it: policy first."""
    config.validate_features()
    return make_pi05_geometry_pre_post_processors(config, make_stats())


def without(batch: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in batch.items() if key not in keys}


def chunk_of(policy: PI05GeometryPolicy, batch: dict[str, Any], **kwargs: Any) -> Tensor:
    """An action chunk at the start of an episode, from noise that is always the same."""
    config, random = policy.config, torch.Generator().manual_seed(9)
    noise = torch.randn(len(batch[TOKENS]), config.chunk_size, config.max_action_dim, generator=random)
    policy.reset()
    return policy.predict_action_chunk(batch, noise=noise, **kwargs)
