"""LoRA through PEFT (`--peft.*`): which matrices get it, and which modules are trained in full.

The new parameters are trained in full, since they have no pretrained values that a low rank could correct. The flow's
projections are small and trained in full too. The count of optimiser steps is saved with them: noise is keyed by it, so a
resumed run draws the same noise.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig

_PROJECTIONS = r"(?:self_attn\.[qkvo]_proj|mlp\.(?:gate|up|down)_proj)"
_READ_IN_THE_LAST_LAYER = r"self_attn\.[kv]_proj"  # of prefix and geometry; their other matrices there are not used


def peft_targets(config: "PI05GeometryConfig") -> dict[str, Any]:
    """`target_modules` (a regular expression) and `modules_to_save` of PEFT, for `config.lora_targets`.

    Matrices whose output is not used get no LoRA: it would never have a gradient.
    """
    network = config.network()
    last = network.expert.depth - 1
    unread_end = rf"(?!{last}\.)\d+\.{_PROJECTIONS}|{last}\.{_READ_IN_THE_LAST_LAYER}"
    models = [rf"gemma_expert\.model\.layers\.\d+\.{_PROJECTIONS}", rf"geometry_expert\.layers\.(?:{unread_end})"]
    if config.lora_targets == "expert+vlm":
        models.append(rf"paligemma\.model\.language_model\.layers\.(?:{unread_end})")
    small = ["model.action_in_proj", "model.action_out_proj", "model.time_mlp_in", "model.time_mlp_out"]
    return {
        "target_modules": rf"model\.paligemma_with_expert\.(?:{'|'.join(models)})",
        "modules_to_save": [*always_in_full(config), *small],
    }


def always_in_full(config: "PI05GeometryConfig") -> list[str]:
    """Modules that are trained in full and saved whatever `--peft.full_training_modules` says."""
    names = ["progress"]
    geometry = config.network().geometry
    if geometry is not None:
        names.append("geometry.adapter")
        if geometry.placement == "segment":
            names.append("model.paligemma_with_expert.geometry_gate")
    return names
