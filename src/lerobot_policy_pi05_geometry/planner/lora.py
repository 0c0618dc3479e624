"""Low-rank adapters as PEFT lays them over linear layers: which layers, how many parameters, what they remember."""

import re
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

LoraTarget = Literal["expert", "all"]

_PROJECTIONS = r"(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
_EXPERT = rf"model\.paligemma_with_expert\.(gemma_expert\.model|geometry_expert)\.layers\.\d+\.{_PROJECTIONS}"
_VLM = rf"model\.paligemma_with_expert\.paligemma\.model\.language_model\.layers\.\d+\.{_PROJECTIONS}"
# Full names of the linear layers that get an adapter, as a regular expression.
LORA_TARGETS: dict[LoraTarget, str] = {"expert": _EXPERT, "all": f"{_EXPERT}|{_VLM}"}


@dataclass(frozen=True)
class LoraPlan:
    """rank of the adapters. target: "expert", or "all" for expert and VLM."""

    rank: int = 16
    target: LoraTarget = "expert"


def lora_layers(policy: nn.Module, target: LoraTarget) -> dict[str, nn.Linear]:
    """The linear layers that get an adapter, by full name.

    Not those that feed nothing (last layer of prefix and geometry): their weights are frozen in every case.
    """
    pattern = re.compile(LORA_TARGETS[target])
    return {
        name: module
        for name, module in policy.named_modules()
        if isinstance(module, nn.Linear) and pattern.fullmatch(name)
    }


def lora_parameters(policy: nn.Module, plan: LoraPlan) -> int:
    """Number of parameters of all adapters: rank x (inputs + outputs) per layer."""
    return sum(plan.rank * (m.in_features + m.out_features) for m in lora_layers(policy, plan.target).values())


def add_lora(policy: nn.Module, plan: LoraPlan) -> None:
    """Freeze all but geometry's own parameters, and lay float32 adapters over the target's layers, on the spot.

    They compute and remember what PEFT's do: a float32 copy of the input (cast again under autocast), and two products.
    """
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(name.startswith("geometry.") or ".geometry_gate." in name)
    for layer in lora_layers(policy, plan.target).values():
        down = nn.Parameter(torch.empty(plan.rank, layer.in_features))
        up = nn.Parameter(torch.empty(layer.out_features, plan.rank))
        layer.register_parameter("lora_down", down)
        layer.register_parameter("lora_up", up)
        layer.register_forward_hook(partial(_low_rank, down, up))


def _low_rank(down: Tensor, up: Tensor, layer: nn.Module, args: tuple[Any, ...], output: Tensor) -> Tensor:
    low = F.linear(args[0].to(down.dtype), down)
    return (output + F.linear(low, up) * 1.0).to(output.dtype)  # times PEFT's scaling
