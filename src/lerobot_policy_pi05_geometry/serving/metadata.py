"""What a client is told first: how to ask this server, and what it will answer."""

from typing import Any

from lerobot.configs import RTCAttentionSchedule

from .engine import PolicyEngine
from .inputs import Inputs
from .limits import PROTOCOL


def describe(engine: PolicyEngine, inputs: Inputs, seed: int, version: str) -> dict[str, Any]:
    """A map of strings, numbers and lists, without arrays. `session` is added per connection."""
    config = engine.config
    assert config.action_feature is not None  # validate_features adds it
    return {
        "protocol": PROTOCOL,
        "server": f"lerobot_policy_pi05_geometry {version}",
        "policy": config.type,
        "chunk_size": config.chunk_size,
        "n_action_steps": config.n_action_steps,
        "action_dim": config.action_feature.shape[0],
        "action_names": config.action_feature_names,
        "endpoints": ["infer", "reset"],
        "inputs": {
            key: {
                "shape": [size or None for size in entry.shape],  # None: any number of pixels
                "trained_size": list(inputs.trained_size[key]) if key in inputs.trained_size else None,
                "dtypes": list(entry.dtypes),
                "unit": entry.unit,
                "required": entry.required,
            }
            for key, entry in inputs.expected.items()
        },
        "prompt": "one text, as prompt or task",
        "depth_unit": config.depth_unit,
        # A request names one of these as `rig`; it need not if there is a default, or if its session has done so before.
        "rigs": inputs.rigs.ids,
        "default_rig": inputs.rigs.default,
        "real_time_chunking": {
            "inference_delay": "actions executed before the new chunk arrives",
            "executed_steps": "actions of the last chunk executed when the observation was made",
            "execution_horizon": "optional",
            "max_guidance_weight": "optional",
            "prefix_attention_schedule": [schedule.value.lower() for schedule in RTCAttentionSchedule],
        },
        "noise": {"shape": list(engine.noise_shape), "seed": seed, "key": "seed, session, request"},
    }
