"""Load a checkpoint with its processors, as lerobot-eval does, for the commands of this package."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..modeling_pi05_geometry import PI05GeometryPolicy
from ..weight_files.files import require_policy_type


@dataclass
class LoadedPolicy:
    """A policy with its processors."""

    policy: PI05GeometryPolicy
    preprocess: Callable[[dict], dict]
    postprocess: Callable[[torch.Tensor], torch.Tensor]


def load_policy(
    checkpoint: str | Path, device: str = "cpu", environment: Any | None = None, num_inference_steps: int | None = None
) -> LoadedPolicy:
    """Load a checkpoint folder or hub id. LoRA is merged into the weights.

    environment: a LeRobot `EnvConfig` whose features the policy has to fit, or None. num_inference_steps: denoising steps of a
    chunk, instead of the checkpoint's.
    Raises FileNotFoundError or ValueError if it is not a checkpoint of this policy.
    """
    config = read_config(checkpoint)
    config.pretrained_path = Path(checkpoint)
    config.device = device
    if num_inference_steps is not None:
        config.num_inference_steps = num_inference_steps
    if config.use_peft:
        policy = _fold_lora(checkpoint, config)
    elif environment is None:
        policy = PI05GeometryPolicy.from_pretrained(checkpoint, config=config)
    else:
        policy = make_policy(config, env_cfg=environment)
    preprocess, postprocess = make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=str(checkpoint),
        preprocessor_overrides={"device_processor": {"device": device}},
    )
    return LoadedPolicy(policy, preprocess, postprocess)


def read_config(checkpoint: str | Path, **hub: Any) -> PI05GeometryConfig:
    """The configuration of a checkpoint of this policy.

    Raises FileNotFoundError if there is none, ValueError if it is another policy's or has a setting that this version does not.
    """
    require_policy_type(checkpoint, PI05GeometryPolicy.name, **hub)
    try:
        config = PreTrainedConfig.from_pretrained(checkpoint, **hub)
    except draccus.ParsingError as error:  # of the configuration's own sentences it is the cause
        told = error if isinstance(error, draccus.utils.DecodingError) else error.__cause__ or error
        raise ValueError(f"The settings of {checkpoint} do not fit this version of the policy: {told}") from error
    assert isinstance(config, PI05GeometryConfig)
    return config


def _fold_lora(checkpoint: str | Path, config: PreTrainedConfig) -> PI05GeometryPolicy:
    """The base policy of a LoRA checkpoint, with the LoRA merged into its weights.

    Raises ImportError without PEFT, ValueError or FileNotFoundError if the base policy is not named or does not exist.
    """
    if importlib.util.find_spec("peft") is None:
        raise ImportError(
            f"{checkpoint} was trained with LoRA, which needs PEFT; install it with "
            "`pip install 'lerobot_policy_pi05_geometry[lora]'`."
        )
    from peft import PeftConfig, PeftModel

    adapter = PeftConfig.from_pretrained(str(checkpoint))
    base = adapter.base_model_name_or_path
    if not base:
        raise ValueError(f"{checkpoint} does not say which policy it was trained from (base_model_name_or_path).")
    policy = PI05GeometryPolicy.from_pretrained(base, config=config)
    folded: PI05GeometryPolicy = PeftModel.from_pretrained(policy, str(checkpoint), config=adapter).merge_and_unload()
    folded.config.use_peft = False
    return folded.eval()
