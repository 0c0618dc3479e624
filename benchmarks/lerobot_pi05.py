"""LeRobot's own π0.5 at any size of this package's variants table, for tests and side-by-side timings.

This is the only file that patches LeRobot: its network hard-codes the sizes of the released checkpoint. Three names are
replaced while the network is built and restored afterwards; the code that runs is LeRobot's. Its layers assume 8 heads.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import draccus
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Policy, PI05Pytorch
from torch import nn

from lerobot_policy_pi05_geometry.model.variants import (
    EXPERT_VARIANTS,
    PALIGEMMA_VARIANTS,
    GemmaVariant,
    PaliGemmaVariant,
)

# LeRobot refuses other names; `_built_at` swaps the sizes beneath them.
_RELEASED = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}
# Matrices that π0.5 never reads, and that this package does not build.
LM_HEADS = (
    "paligemma_with_expert.paligemma.lm_head.weight",
    "paligemma_with_expert.gemma_expert.lm_head.weight",
)
# Parameters that π0.5 does not have.
GEOMETRY_PREFIXES = ("paligemma_with_expert.geometry_gate.", "paligemma_with_expert.geometry_expert.")


def build_lerobot_pi05(
    paligemma_variant: str,
    action_expert_variant: str,
    *,
    image_size: int,
    chunk_size: int,
    max_action_dim: int,
    num_inference_steps: int = 10,
    dtype: str = "float32",
    **config: Any,
) -> PI05Pytorch:
    """LeRobot's network, freshly initialised, on the default device (`torch.device("meta")` works).

    paligemma_variant, action_expert_variant: keys of this package's tables. config: further fields of LeRobot's
    `PI05Config`, such as `train_expert_only`.
    """
    settings = PI05Config(
        **_RELEASED,
        image_resolution=(image_size, image_size),
        chunk_size=chunk_size,
        n_action_steps=chunk_size,
        max_action_dim=max_action_dim,
        num_inference_steps=num_inference_steps,
        dtype=dtype,
        device="cpu",
        **config,
    )
    with _built_at(PALIGEMMA_VARIANTS[paligemma_variant], EXPERT_VARIANTS[action_expert_variant]):
        return PI05Pytorch(settings)


def build_lerobot_policy(paligemma_variant: str, action_expert_variant: str, **config: Any) -> PI05Policy:
    """LeRobot's policy at these sizes, freshly initialised. config: further fields of `PI05Config`."""
    with _built_at(PALIGEMMA_VARIANTS[paligemma_variant], EXPERT_VARIANTS[action_expert_variant]):
        return PI05Policy(PI05Config(**_RELEASED, **config))


def load_lerobot_policy(folder: Path) -> PI05Policy:
    """A checkpoint folder in LeRobot's layout, loaded by LeRobot, at the sizes that its config.json names."""
    settings = json.loads((folder / "config.json").read_text())
    sizes = PALIGEMMA_VARIANTS[settings["paligemma_variant"]], EXPERT_VARIANTS[settings["action_expert_variant"]]
    del settings["type"]
    with _built_at(*sizes):
        config = draccus.decode(PI05Config, {**settings, **_RELEASED, "device": "cpu"})
        return PI05Policy.from_pretrained(folder, config=config)


def copy_weights(source: nn.Module, target: nn.Module) -> None:
    """Copy every weight of LeRobot's π0.5 but its two lm_heads into this package's network.

    Raises ValueError if a tensor finds no place, or if the target has one that is not about geometry and was not set.
    """
    weights = {name: tensor for name, tensor in source.state_dict().items() if name not in LM_HEADS}
    missing, unexpected = target.load_state_dict(weights, strict=False)
    unset = [name for name in missing if not name.startswith(GEOMETRY_PREFIXES)]
    if unset or unexpected:
        raise ValueError(f"The networks differ: only LeRobot's has {unexpected}, only the target has {unset}.")


@contextmanager
def _built_at(paligemma: PaliGemmaVariant, expert: GemmaVariant) -> Iterator[None]:
    """Let LeRobot build these sizes where it would build the released ones."""
    gemma = {"gemma_2b": paligemma.gemma, "gemma_300m": expert}
    build_paligemma, build_expert = (
        modeling_pi05.PaliGemmaForConditionalGenerationWithPiGemma,
        modeling_pi05.PiGemmaForCausalLM,
    )

    def resized_paligemma(config: Any) -> nn.Module:
        config.text_config.vocab_size = paligemma.vocab_size
        vision = config.vision_config
        vision.hidden_size = paligemma.vision.width
        vision.num_hidden_layers = paligemma.vision.depth
        vision.intermediate_size = paligemma.vision.mlp_dim
        vision.num_attention_heads = paligemma.vision.num_heads
        vision.patch_size = paligemma.vision.patch_size
        vision.projection_dim = paligemma.gemma.width
        return build_paligemma(config=config)

    def resized_expert(config: Any) -> nn.Module:
        config.vocab_size = paligemma.vocab_size
        return build_expert(config=config)

    with patch.multiple(
        modeling_pi05,
        get_gemma_config=lambda name: modeling_pi05.GemmaConfig(**asdict(gemma[name])),
        PaliGemmaForConditionalGenerationWithPiGemma=resized_paligemma,
        PiGemmaForCausalLM=resized_expert,
    ):
        yield
