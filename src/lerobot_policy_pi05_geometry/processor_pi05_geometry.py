"""Pre- and post-processing, in openpi's order: raw -> relative -> normalise -> prompt -> policy -> back.

Processors carry depth and calibration through untouched: they are rebuilt from their own JSON and never see the
policy's configuration, so geometry is prepared inside the policy (see modeling_pi05_geometry.py).
"""

from typing import Any

import torch
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    PolicyProcessorPipeline,
    RelativeActionsProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from .configuration_pi05_geometry import PI05GeometryConfig
from .data.prompt import PortableTokenizerProcessorStep, PromptProcessorStep, check_vocabulary
from .data.statistics import check_stats
from .model.variants import PALIGEMMA_VARIANTS


def make_pi05_geometry_pre_post_processors(
    config: PI05GeometryConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The two pipelines of a new policy. LeRobot finds this function by its name.

    Steps that LeRobot has keep its registry names, since lerobot-train overrides them by name. The state is normalised
    before the prompt is written from it.
    """
    config.validate_features()  # depth and poses must not reach the normaliser, whoever builds processors first
    if dataset_stats:
        check_stats(config, dataset_stats)
    tokenizer = PortableTokenizerProcessorStep(tokenizer_name=config.tokenizer, max_length=config.tokenizer_max_length)
    check_vocabulary(tokenizer, PALIGEMMA_VARIANTS[config.paligemma_variant].vocab_size)
    relative = RelativeActionsProcessorStep(
        enabled=config.use_relative_actions,
        exclude_joints=config.relative_exclude_joints,
        action_names=config.action_feature_names,
    )
    steps = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            relative,
            steps.normalize,
            PromptProcessorStep(),
            tokenizer,
            steps.to_device,
        ],
        output_steps=[
            steps.unnormalize,
            AbsoluteActionsProcessorStep(enabled=config.use_relative_actions, relative_step=relative),
            steps.to_cpu,
        ],
    )
