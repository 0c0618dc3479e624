"""Pre- and postprocessor, in openpi's order: raw -> relative -> normalised -> prompt -> policy -> back.

Processors do not change depth and calibration. LeRobot rebuilds a saved processor from its own JSON, without the policy's
configuration, so geometry is prepared inside the policy (modeling_pi05_geometry.py).
"""

from typing import Any

import torch
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import (
    PolicyProcessorPipeline,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from .configuration_pi05_geometry import PI05GeometryConfig
from .data.normaliser_scale import NormaliserProbeStep, NormaliserScaleStep, constant_of
from .data.prompt import PromptProcessorStep
from .data.raw_state import RawStateProcessorStep
from .data.relative_actions import absolute_actions_processor, relative_actions_processor
from .data.state_width import StateWidthStep
from .data.statistics import check_stats
from .data.tokenizer import PortableTokenizerProcessorStep, check_vocabulary
from .model.variants import PALIGEMMA_VARIANTS


def make_pi05_geometry_pre_post_processors(
    config: PI05GeometryConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The two pipelines of a new policy. LeRobot finds this function by its name.

    Steps that LeRobot has keep its names, since lerobot-train overrides their settings by name. The state is normalised
    before the prompt is written from it.
    """
    config.validate_features()  # LeRobot may build processors before the policy; depth and poses must not be normalised
    if dataset_stats:
        check_stats(config, dataset_stats)
    tokenizer = PortableTokenizerProcessorStep(tokenizer_name=config.tokenizer, max_length=config.tokenizer_max_length)
    check_vocabulary(tokenizer, PALIGEMMA_VARIANTS[config.paligemma_variant].vocab_size)
    steps = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            StateWidthStep(),
            RawStateProcessorStep(),
            relative_actions_processor(
                enabled=config.use_relative_actions,
                exclude_joints=config.relative_exclude_joints,
                action_names=config.action_feature_names,
            ),
            NormaliserProbeStep(),
            steps.normalize,
            NormaliserScaleStep(constant=constant_of(config.normalization_mapping.get("STATE"))),
            PromptProcessorStep(),
            tokenizer,
            steps.to_device,
        ],
        output_steps=[
            steps.unnormalize,
            absolute_actions_processor(enabled=config.use_relative_actions),
            steps.to_cpu,
        ],
    )
