"""Attention in one function, for every query of the network.

Two ways to compute the same thing. `scaled_dot_product_attention` is the default. It falls back to its slow path when
the mask needs a gradient, which the suffix's does while the gate is trained, and on a CPU its backward is slower than
two matrix products at small sizes; there the products are written out. benchmarks/attention.py measures both.

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
        needs_grad = torch.is_grad_enabled() and q.requires_grad
        gate_needs_grad = torch.is_grad_enabled() and bias is not None and bias.requires_grad
        if gate_needs_grad or (needs_grad and q.device.type == "cpu"):
            return torch.matmul(attention_weights(q, k, mask, bias), v.repeat_interleave(q.shape[1] // v.shape[1], 1))
        attn_mask = mask[:, None]
        if bias is not None:
            attn_mask = bias[:, None].to(q.dtype).masked_fill(~attn_mask, float("-inf"))
        return F.scaled_dot_product_attention(q, k, v, attn_mask=attn_mask, enable_gqa=q.shape[1] != k.shape[1])


def attention_weights(q: Tensor, k: Tensor, mask: Tensor, bias: Tensor | None = None) -> Tensor:
    """The softmax of `Attention`, (B, H, Q, K) in q's dtype; shapes as there."""
    k = k.repeat_interleave(q.shape[1] // k.shape[1], dim=1)
    scores = torch.matmul(q, k.transpose(-1, -2)).float() * q.shape[-1] ** -0.5
    if bias is not None:
        scores = scores + bias[:, None]
    scores = scores.masked_fill(~mask[:, None], float("-inf"))
    return scores.softmax(dim=-1).to(q.dtype)
