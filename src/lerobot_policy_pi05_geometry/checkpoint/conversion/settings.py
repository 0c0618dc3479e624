"""Fields of the two configurations, both ways: what LeRobot's π0.5 and ours both have goes across as it stands."""

import json
import logging
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from ...configuration_pi05_geometry import EMPTY_CAMERA, PI05GeometryConfig

logger = logging.getLogger(__name__)

LEROBOT_TYPE = "pi05"
# Belongs to the source's machine, hub account or training run, or is chosen anew.
NOT_CARRIED = {
    "type", "device", "use_amp", "repo_id", "private", "tags", "pretrained_path", "pretrained_revision", "use_peft",
    "compile_model", "compile_mode",
}  # fmt: skip
# LeRobot 0.6.2's memory of earlier observations (MEM, arXiv 2603.03596): sizes that say nothing while it is off.
_MEMORY_SWITCHES = ("use_visual_memory", "use_proprioceptive_memory")
_MEMORY = {*_MEMORY_SWITCHES, "memory_frames", "memory_stride", "memory_temporal_attention_every"}
# What openpi's converter writes, and our names of it.
_OPENPI = {
    "action_horizon": "chunk_size",
    "paligemma_variant": "paligemma_variant",
    "action_expert_variant": "action_expert_variant",
}


def from_lerobot(source: Mapping[str, Any], path: object) -> dict[str, Any]:
    """The fields of a LeRobot π0.5's config.json that carry over, as JSON."""
    if source.get("use_peft"):
        raise ValueError(
            f"{path} is of a PEFT run, which saves adapters and not a policy; merge them into their base checkpoint first."
        )
    if any(source.get(switch) for switch in _MEMORY_SWITCHES):
        raise ValueError(
            f"{path} remembers earlier observations ({' or '.join(_MEMORY_SWITCHES)}), which this policy does not; convert a "
            "π0.5 without memory."
        )
    known = {field.name for field in fields(PI05GeometryConfig)}
    lost = sorted(set(source) - known - NOT_CARRIED - _MEMORY)
    if lost:
        logger.warning("%s has settings that this policy does not have, left out: %s.", path, ", ".join(lost))
    settings = {name: value for name, value in source.items() if name in known - NOT_CARRIED}
    # LeRobot keeps the empty cameras it adds among the inputs; here they are added on the other side of `validate_features`.
    features = settings.get("input_features") or {}
    if not isinstance(features, Mapping):
        raise ValueError(
            f"{path} is no policy configuration: its input_features must be an object of features by name."
        )
    inputs = features.items()
    return settings | {"input_features": {key: value for key, value in inputs if not key.startswith(EMPTY_CAMERA)}}


def from_openpi(source: Mapping[str, Any], chunk_size: int | None, path: object) -> dict[str, Any]:
    """Fields that the config.json of an openpi checkpoint tells; {} where it has none. chunk_size: if it is given."""
    settings = {ours: source[theirs] for theirs, ours in _OPENPI.items() if theirs in source}
    chunk_size = settings.get("chunk_size") if chunk_size is None else chunk_size
    if chunk_size is None:
        raise ValueError(
            f"{path} does not say how many actions a chunk has (openpi's action_horizon), and neither do its weights; give "
            "--chunk-size."
        )
    return settings | {"chunk_size": chunk_size, "n_action_steps": chunk_size}


def make_config(settings: Mapping[str, Any], path: object) -> PI05GeometryConfig:
    """Our configuration from JSON fields. Raises ValueError naming what does not fit."""
    try:
        return draccus.decode(PI05GeometryConfig, {**settings, "device": "cpu"})
    except draccus.utils.ParsingError as error:
        # draccus names a field of a wrong type, but hides what a configuration says about its own values.
        told = error if isinstance(error, draccus.utils.DecodingError) else error.__cause__ or error
        raise ValueError(f"The settings of {path} do not fit this policy: {told}") from error


def save_config(config: PreTrainedConfig, folder: Path) -> None:
    """Write config.json without a device: whoever loads it takes the best one there is."""
    device, config.device = config.device, None
    config._save_pretrained(folder)
    config.device = device


def to_lerobot(config: PI05GeometryConfig) -> dict[str, Any]:
    """config.json of LeRobot's π0.5 with our settings, geometry dropped."""
    ours = json.loads(json.dumps(draccus.encode(config, PreTrainedConfig)))
    settings = {field.name: ours[field.name] for field in fields(PI05Config) if field.name in ours}
    # Cameras that may be absent stand apart here; LeRobot's π0.5 masks whichever is missing, and adds empty ones itself.
    absent = {key: value for key, value in ours["optional_cameras"].items() if not key.startswith(EMPTY_CAMERA)}
    settings["input_features"] = settings["input_features"] | absent
    return settings | {"type": LEROBOT_TYPE, "device": None, "pretrained_path": None, "pretrained_revision": None}
