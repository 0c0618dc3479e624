"""How much of its attention the actions may give to geometry.

New tokens take softmax mass from the pretrained ones, so the suffix's softmax weight on geometry keys is multiplied by a
learned openness per layer and head: its logarithm is added to the attention logits. 1 is open; at 1e-7 a warm-started policy
begins as the one it came from.

The openness itself is the parameter, and not its logarithm: the gradient of a logarithm shrinks with the openness, and a
log-gate that started at -16 was still shut after 1,500 steps of fine-tuning (docs/results.md). The magnitude is what counts, so
a step past zero opens the gate again. Below 1e-8 the logarithm stays where it is and the gradient is passed through: log 0
would make it NaN, and with a gradient of 0 the parameter would stay there.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .precision import Float32Module

SMALLEST = 1e-8  # smallest openness that the logarithm is taken of


class GeometryGate(Float32Module):
    """Openness of all layers and heads, (layers, heads) float32. A module, so that PEFT can save it in full."""

    def __init__(self, num_layers: int, num_heads: int, openness: float) -> None:
        super().__init__()
        self.openness = nn.Parameter(torch.full((num_layers, num_heads), float(openness)))

    def forward(self, layer: int, before: int, geometry: int, after: int) -> Tensor:
        """Additive attention bias of one layer, (heads, before + geometry + after): log openness on geometry, else 0."""
        return F.pad(log_openness(self.openness[layer])[:, None].expand(-1, geometry), (before, after))

    @torch.no_grad()
    def mean_openness(self) -> Tensor:
        """Mean magnitude over layers and heads, a scalar: 1 is open, 0 is shut."""
        return self.openness.abs().mean()


def log_openness(openness: Tensor) -> Tensor:
    """log(max(|openness|, 1e-8)), float32, whose gradient is that of log |openness| with the magnitude clamped likewise."""
    magnitude = torch.where(openness < 0, -openness, openness).float()  # not abs(), whose gradient at 0 is 0
    return (magnitude + (magnitude.clamp_min(SMALLEST) - magnitude).detach()).log()
