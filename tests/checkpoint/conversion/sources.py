"""Checkpoints to convert: LeRobot's own π0.5 at the `tiny` size with random weights, and openpi's layout of the same."""

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from benchmarks.lerobot_pi05 import build_lerobot_policy
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    RelativeActionsProcessorStep,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_policy_pi05_geometry.data.small_tokenizer import build_small_tokenizer
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    STATE,
    STATE_DIM,
    TOKEN_MASK,
    TOKENS,
    WRIST,
    make_calibration,
    make_stats,
)
from tests.model.helpers import randomise

Tensors = dict[str, Tensor]

# Settings of LeRobot 0.6.2's π0.5 that 0.6.1's does not have.
ONLY_0_6_2 = {"memory_frames", "memory_stride", "memory_temporal_attention_every", "rtc_training_max_delay"} | {
    f"use_{kind}_memory" for kind in ("visual", "proprioceptive")
}
VLM_HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
EXPERT_HEAD = "paligemma_with_expert.gemma_expert.lm_head.weight"
EMBEDDING = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
# What depth cameras a dataset declares, in a dataset's own form.
DATASET_FEATURES = {
    f"{FRONT}_depth": {"dtype": "video", "shape": (18, 24, 1), "names": ["height", "width", "channels"]},
    f"{WRIST}_depth": {"dtype": "video", "shape": (12, 12, 1), "names": ["height", "width", "channels"]},
    "observation.calibration.wrist.extrinsics": {"dtype": "float32", "shape": (4, 4), "names": None},
    STATE: {"dtype": "float32", "shape": (STATE_DIM,), "names": None},
}
CALIBRATION = {
    "frame": "base",
    "cameras": {name: vars(camera) for name, camera in make_calibration().items()},
}


@lru_cache
def lerobot_policy(**changes: Any) -> PI05Policy:
    """LeRobot's own, in evaluation mode; do not change it."""
    torch.manual_seed(0)
    settings = {
        "device": "cpu",
        "image_resolution": (28, 28),
        "chunk_size": CHUNK,
        "n_action_steps": 4,
        "max_action_dim": 8,
        "num_inference_steps": 3,
        "tokenizer_max_length": 96,
        "optimizer_lr": 1.25e-5,
    }
    inputs = {
        FRONT: PolicyFeature(FeatureType.VISUAL, (3, 30, 40)),
        WRIST: PolicyFeature(FeatureType.VISUAL, (3, 28, 28)),
        STATE: PolicyFeature(FeatureType.STATE, (STATE_DIM,)),
    }
    policy = build_lerobot_policy(
        "tiny", "tiny", input_features=inputs, output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))},
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY, "STATE": NormalizationMode.QUANTILES, "ACTION": NormalizationMode.QUANTILES,
        },
        **(settings | changes),
    )  # fmt: skip
    randomise(policy, seed=3)
    return policy.eval()


def lerobot_pipelines(policy: PI05Policy, tokenizer: Path):
    """LeRobot's processors of a π0.5, in its order, with a tokenizer that needs no hub."""
    config = policy.config
    build_small_tokenizer().save_pretrained(tokenizer)
    relative = RelativeActionsProcessorStep(enabled=False, exclude_joints=["gripper"], action_names=None)
    steps = make_default_policy_processor_steps(config, make_stats())
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            relative,
            steps.normalize,
            Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim),
            TokenizerProcessorStep(
                tokenizer_name=str(tokenizer), max_length=config.tokenizer_max_length, padding="max_length"
            ),
            steps.to_device,
        ],
        output_steps=[
            steps.unnormalize,
            AbsoluteActionsProcessorStep(enabled=False, relative_step=relative),
            steps.to_cpu,
        ],
    )


def write_lerobot(folder: Path, change: Callable[[Tensors], Tensors | None] | None = None, **settings: Any) -> Path:
    """A checkpoint folder as LeRobot writes it. change: edits the tensors. settings: entries of config.json."""
    policy = lerobot_policy()
    policy.save_pretrained(folder)
    path = folder / "config.json"
    config = json.loads(path.read_text())
    sizes = {"paligemma_variant": "tiny", "action_expert_variant": "tiny"}
    path.write_text(json.dumps(config | sizes | settings))
    for pipeline in lerobot_pipelines(policy, folder / "tokenizer_of_the_test"):
        pipeline.save_pretrained(folder)
    _edit(folder, change)
    return folder


def write_openpi(folder: Path, change: Callable[[Tensors], Tensors | None] | None = None, **settings: Any) -> Path:
    """A checkpoint folder as openpi's converter writes it: no prefix, and the embedding under its tied head's name."""
    folder.mkdir()
    tensors = {name.removeprefix("model."): tensor for name, tensor in lerobot_policy().state_dict().items()}
    tensors[VLM_HEAD] = tensors.pop(EMBEDDING)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, folder / "model.safetensors")
    config = {
        "action_dim": 8,
        "action_horizon": CHUNK,
        "paligemma_variant": "tiny",
        "action_expert_variant": "tiny",
        "precision": "float32",
    }
    (folder / "config.json").write_text(json.dumps(config | settings))
    _edit(folder, change)
    return folder


def _edit(folder: Path, change: Callable[[Tensors], Tensors | None] | None) -> None:
    if change is not None:
        tensors = load_file(folder / "model.safetensors")
        tensors = change(tensors) or tensors
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, folder / "model.safetensors")


def without_prefix(tensors: Tensors) -> Tensors:
    return {name.removeprefix("model."): tensor for name, tensor in tensors.items()}


def load_on(folder: Path, features: dict[str, Any] | None = None, **changes: Any) -> PI05GeometryPolicy:
    """A converted checkpoint as LeRobot's `make_policy` builds it on a dataset with these features."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.device = "cpu"
    for name, value in changes.items():
        setattr(config, name, value)
    config.set_dataset_feature_metadata(DATASET_FEATURES if features is None else features)
    return PI05GeometryPolicy.from_pretrained(folder, config=config)


def noise_of(batch: dict[str, Any], width: int = 8) -> Tensor:
    """The noise that `tests.doors.chunk_of` starts from."""
    return torch.randn(len(batch[TOKENS]), CHUNK, width, generator=torch.Generator().manual_seed(9))


def lerobot_chunk(policy: PI05Policy, batch: dict[str, Any]) -> Tensor:
    """LeRobot's action chunk from the same noise as `tests.doors.chunk_of`."""
    wanted = {key: batch[key] for key in (FRONT, WRIST, TOKENS, TOKEN_MASK)}
    return policy.predict_action_chunk(wanted, noise=noise_of(batch))


def folder_contents(folder: Path) -> set[str]:
    """Everything in a folder, hidden leftovers too."""
    return {path.name for path in folder.iterdir()}
