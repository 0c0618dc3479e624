"""The norms of a Gemma layer, plain and adaptive, and the residual that follows them. Modules and runner both compute with these.

Shapes: B batch, N tokens, W width.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .precision import Float32Linear, Float32Module

RMS_EPS = 1e-6


def normalise(x: Tensor) -> Tensor:
    """x / rms(x), float32."""
    return F.rms_norm(x.float(), (x.shape[-1],), eps=RMS_EPS)


def plain_norm(x: Tensor, weight: Tensor) -> Tensor:
    """x / rms(x) * (1 + weight) for x (B, N, W) and weight (W,), computed in float32, returned in x's dtype."""
    normed = normalise(x)
    return torch.addcmul(normed, normed, weight).to(x.dtype)


class Modulation(NamedTuple):
    """What the flow time gives to one adaptive norm: 1 + scale, shift, and the gate of the residual.

    Float32, each (W,), (N, W), or (B or 1, 1 or N, W).
    """

    scale: Tensor
    shift: Tensor
    gate: Tensor

    @classmethod
    def of(cls, given: Tensor) -> "Modulation":
        """From the output (..., 3 W) of the norm's linear map."""
        scale, shift, gate = given.chunk(3, dim=-1)
        return cls(1.0 + scale, shift, gate)

    def norm(self, x: Tensor) -> Tensor:
        """x / rms(x) * (1 + scale) + shift for x (B, N, W), computed in float32, returned in x's dtype (adaRMS, π0.5)."""
        return torch.addcmul(self.shift, normalise(x), self.scale).to(x.dtype)


def add_residual(x: Tensor, update: Tensor, gate: Tensor | None) -> Tensor:
    """x + update * gate in x's dtype; x and update (B, N, W), gate as in `Modulation`, None for 1."""
    update = update.to(x.dtype)
    return x + update if gate is None else torch.addcmul(x, update, gate.to(x.dtype))


class RMSNorm(Float32Module):
    """The plain norm of the VLM, with no residual gate."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, cond: Tensor | None = None) -> tuple[Tensor, None]:
        """x (B, N, W) -> (B, N, W) and None."""
        return plain_norm(x, self.weight), None


class AdaRMSNorm(nn.Module):
    """The adaptive norm of an expert: scale, shift and residual gate come from the flow time (adaRMS, π0.5)."""

    def __init__(self, width: int, cond_dim: int) -> None:
        super().__init__()
        self.dense = Float32Linear(cond_dim, 3 * width)
        nn.init.zeros_(self.dense.weight)

    def forward(self, x: Tensor, cond: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Modulate x (B, N, W) by cond, (B or 1, cond_dim) float32, or (B, K, cond_dim): K conditions of N / K tokens each.

        Returns (B, N, W) in x's dtype and the residual gate, (B or 1, 1 or N, W) float32.
        """
        if cond is None:
            raise ValueError("An adaptive norm needs `adarms_cond`, the embedded flow time of its segment.")
        given = self.dense(cond[:, None] if cond.ndim == 2 else cond)  # (B or 1, 1 or K, 3 W)
        if given.shape[1] not in (1, x.shape[1]):
            given = given.repeat_interleave(x.shape[1] // given.shape[1], dim=1)
        modulation = Modulation.of(given)
        return modulation.norm(x), modulation.gate


def make_norm(width: int, cond_dim: int | None) -> RMSNorm | AdaRMSNorm:
    """The plain norm of the VLM, or the adaptive one of an expert."""
    return RMSNorm(width) if cond_dim is None else AdaRMSNorm(width, cond_dim)
