"""Attention in one function, for every query of the network.

Two ways to compute the same thing. `scaled_dot_product_attention` is the default. It falls back to its slow path when
the mask needs a gradient, which the suffix's does while the gate is trained; there, two matrix products and a softmax are
written out. benchmarks/attention.py measures both (docs/results.md).

Shapes: B batch, H query heads, KV key/value heads, Q queries, K keys, D head_dim.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn


def apply_rotary(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate pairs (i, i + D/2) of x, (B, heads, N, D), by angles (B, N, D/2), in float32. Source: transformers Gemma."""
    first, second = x.float().chunk(2, dim=-1)
    cos, sin = cos[:, None], sin[:, None]
    return torch.cat([first * cos - second * sin, second * cos + first * sin], dim=-1).to(x.dtype)


def rotary_table(positions: Tensor, head_dim: int, base: float = 10_000.0) -> tuple[Tensor, Tensor]:
    """cos and sin of the rotary angles, each (B, N, D/2) float32, for integer positions (B, N)."""
    exponent = torch.arange(0, head_dim, 2, dtype=torch.float32, device=positions.device) / head_dim
    angles = positions[..., None].float() / base**exponent
    return angles.cos(), angles.sin()


class Attention(nn.Module):
    """softmax(q k^T / sqrt(D) + bias) v over the keys that the mask lets through. No parameters.

    A module, so that a forward hook can look at what it is given (see inspect/attention.py).
    """

    def forward(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor, bias: Tensor | None = None) -> Tensor:
        """q (B, H, Q, D), k and v (B, KV, K, D), mask (B, 1 or Q, K) bool, bias (H, K) float32 or None -> (B, H, Q, D)."""
        # The gate needs a gradient, or more than bf16's three digits.
        gate_in_float32 = bias is not None and (
            q.dtype != torch.float32 or (torch.is_grad_enabled() and bias.requires_grad)
        )
        if gate_in_float32:
            weights = attention_weights(q, k, mask, bias)  # (B, H, Q, K)
            return torch.matmul(_fold(weights, v), v).view_as(q)
        # Keys are expanded as views: with `enable_gqa` and a mask, CUDA has no fast kernel.
        shared = q.shape[1] // k.shape[1]
        k, v = (x[:, :, None].expand(-1, -1, shared, -1, -1).flatten(1, 2) for x in (k, v))
        return F.scaled_dot_product_attention(q, k, v, attn_mask=_logit_bias(mask, bias, q.dtype))


def attention_weights(q: Tensor, k: Tensor, mask: Tensor, bias: Tensor | None = None) -> Tensor:
    """The softmax of `Attention`, (B, H, Q, K) in q's dtype; shapes as there."""
    scores = torch.matmul(_fold(q * q.shape[-1] ** -0.5, k), k.transpose(-1, -2)).float()
    scores = scores.view(*q.shape[:3], k.shape[2]) + _logit_bias(mask, bias, torch.float32)
    return scores.softmax(dim=-1).to(q.dtype)


def _fold(x: Tensor, shared: Tensor) -> Tensor:
    """Queries of all heads that share a key head as rows of one matrix: (B, H, Q, ...) -> (B, KV, H / KV * Q, ...)."""
    return x.reshape(x.shape[0], shared.shape[1], -1, x.shape[-1])


def _logit_bias(mask: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
    """What is added to the logits, (B, 1 or H, 1 or Q, K): 0 or the gate on visible keys, the lowest number on others.

    Not -inf: a row that sees nothing would be NaN.
    """
    hidden = torch.zeros(mask.shape, dtype=dtype, device=mask.device).masked_fill(~mask, torch.finfo(dtype).min)[
        :, None
    ]
    return hidden if bias is None else hidden + bias[:, None].to(dtype)
