"""How open the door between geometry and the actions is.

New tokens take softmax mass from the pretrained ones, so geometry enters through a learned log-gate per layer and
head, added to the suffix's attention logits on geometry keys: exp(gate) multiplies their softmax weight. 0 is open;
-16 leaves a token 1e-7 of its weight, so that a warm-started policy begins as the one it came from.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .precision import Float32Module


class GeometryGate(Float32Module):
    """Log-gates of all layers, (layers, heads), float32. A module, so that PEFT can save it in full."""

    def __init__(self, num_layers: int, num_heads: int, init: float) -> None:
        super().__init__()
        self.log_gate = nn.Parameter(torch.full((num_layers, num_heads), float(init)))

    def forward(self, layer: int, before: int, geometry: int, after: int) -> Tensor:
        """Additive attention bias of one layer, (heads, before + geometry + after): the gate on geometry, 0 elsewhere."""
        return F.pad(self.log_gate[layer][:, None].expand(-1, geometry), (before, after))

    @torch.no_grad()
    def openness(self) -> float:
        """Mean of exp(gate), for logging: 1 is open, 0 is closed."""
        return self.log_gate.exp().mean().item()
