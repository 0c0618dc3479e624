"""The optimiser's parameter groups, and how far the new parameters move per step.

New parameters are those that π0.5 does not have: the geometry adapter with its embeddings, and the gate. π0.5's learning
rate is for fine-tuning and far too small for them. They get rates of their own, a small Adam eps (a closed gate scales the
adapter's gradients down) and no weight decay.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig

FULL_STATE = "full_state"  # key of a group: True keeps its moments in the dtype of its parameters
NAME = "name"  # key of a group
GATE_GROUP = "geometry_gate"  # the name of the gate's group
_ADAPTER, _GATE = "geometry.", ".geometry_gate."  # in the names of the new parameters


def new_parameters(policy: nn.Module) -> dict[str, nn.Parameter]:
    """The parameters that π0.5 does not have, by name."""
    return {name: p for name, p in policy.named_parameters() if name.startswith(_ADAPTER) or _GATE in name}


def parameter_groups(policy: nn.Module, config: "PI05GeometryConfig") -> list[dict[str, Any]]:
    """The trainable parameters in groups: π0.5's, the adapter's, the gate's. Empty groups are left out."""
    new = {name: p for name, p in new_parameters(policy).items() if p.requires_grad}
    ids = {id(p) for p in new.values()}
    groups: list[dict[str, Any]] = [
        {"params": [p for p in policy.parameters() if p.requires_grad and id(p) not in ids]}
    ]
    gate = [p for name, p in new.items() if _GATE in name]
    rest = [p for name, p in new.items() if _GATE not in name]
    common: dict[str, Any] = {"eps": config.geometry_eps, "weight_decay": 0.0}
    if config.optimizer == "adamw8bit":
        common[FULL_STATE] = True
    if rest:
        groups.append({"params": rest, "lr": config.geometry_lr, **common})
    if gate:
        groups.append({"params": gate, "lr": config.geometry_gate_lr, NAME: GATE_GROUP, **common})
    return groups


class UpdateSize:
    """The length of the last update of some parameters, relative to their own length."""

    def __init__(self) -> None:
        self.previous: list[Tensor] = []  # copies of the parameters, as the last call saw them
        self._size: Tensor | None = None  # scalar

    def measure(self, parameters: Sequence[Tensor]) -> None:
        """Compare parameters with what the last call saw."""
        now = [p.detach().clone() for p in parameters]
        before, self.previous = self.previous, now
        if before and len(before) == len(now):
            moved = torch.stack([(a - b).square().sum() for a, b in zip(now, before, strict=True)]).sum()
            size = torch.stack([b.square().sum() for b in before]).sum()
            self._size = (moved / size.clamp_min(1e-12)).sqrt()

    def to_log(self) -> dict[str, Tensor]:
        """`geometry_update_pct` as a share, or nothing before the second call of `measure`."""
        return {} if self._size is None else {"geometry_update_pct": self._size}
