"""Attention in one function, for every query of the network.

There are two implementations. `scaled_dot_product_attention` is the default. It falls back to its slow path when the mask
needs a gradient, as the suffix's mask does while the gate is trained. In this case the code computes two matrix products and
a softmax. benchmarks/attention.py measures both (docs/results-speed.md).

Shapes: B batch, H query heads, KV key/value heads, Q queries, K keys, D head_dim.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn


def rotary_table(positions: Tensor, head_dim: int, base: float = 10_000.0) -> tuple[Tensor, Tensor]:
    """cos and sin of the rotary angles for integer positions (B, N), each (B, 1, N, D) float32, for `apply_rotary`.

    Entries i and i + D/2 turn by the same angle; sin carries the minus sign of the first half. Source: transformers Gemma.
    """
    exponent = torch.arange(0, head_dim, 2, dtype=torch.float32, device=positions.device) / head_dim
    angles = positions[..., None].float() / base**exponent
    cos, sin = angles.cos(), angles.sin()
    return torch.cat([cos, cos], dim=-1)[:, None], torch.cat([-sin, sin], dim=-1)[:, None]


def apply_rotary(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the pairs (i, i + D/2) of x (B, heads, N, D), in float32; returned in x's dtype."""
    precise = x.float()
    first, second = precise.chunk(2, dim=-1)
    return torch.addcmul(precise * cos, torch.cat([second, first], dim=-1), sin).to(x.dtype)


class Attention(nn.Module):
    """softmax(q k^T / sqrt(D) + bias) v over the keys that the mask lets through. No parameters.

    A module, so that a forward hook can read its inputs (see inspect/attention.py).
    """

    def forward(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor, bias: Tensor | None = None) -> Tensor:
        """q (B, H, Q, D), k and v (B, KV, K, D), mask (B, 1 or Q, K) bool, bias (H, K) float32 or None -> (B, H, Q, D)."""
        # The gate needs a gradient, or more digits than bf16 has.
        gate_in_float32 = bias is not None and (
            q.dtype != torch.float32 or (torch.is_grad_enabled() and bias.requires_grad)
        )
        if gate_in_float32:
            weights = attention_weights(q, k, mask, bias)  # (B, H, Q, K)
            return torch.matmul(fold_heads(weights, v.shape[1]), v).view_as(q)
        # Keys are expanded as views: with `enable_gqa` and a mask, CUDA has no fast kernel.
        shared = q.shape[1] // k.shape[1]
        k, v = (x[:, :, None].expand(-1, -1, shared, -1, -1).flatten(1, 2) for x in (k, v))
        return F.scaled_dot_product_attention(q, k, v, attn_mask=logit_bias(mask, bias, q.dtype))


def attention_weights(q: Tensor, k: Tensor, mask: Tensor, bias: Tensor | None = None) -> Tensor:
    """The softmax of `Attention`, (B, H, Q, K) in q's dtype; shapes as there."""
    scores = _scores(fold_heads(q, k.shape[1]), k).view(*q.shape[:3], k.shape[2])
    return (scores + logit_bias(mask, bias, torch.float32)).softmax(dim=-1).to(q.dtype)


def attend_in_products(q: Tensor, k: Tensor, v: Tensor, bias: Tensor) -> Tensor:
    """softmax(q k^T / sqrt(D) + bias) v as two products and a softmax, for folded heads and without a gradient.

    q (B, KV, H / KV * Q, D), k and v (B, KV, K, D), bias (B, 1 or KV, 1 or H / KV * Q, K) -> as q.
    """
    return torch.matmul(_scores(q, k).add_(bias).softmax(dim=-1).to(q.dtype), v)


def fold_heads(x: Tensor, kv_heads: int) -> Tensor:
    """Queries of all heads that share a key head as rows of one matrix: (B, H, Q, ...) -> (B, KV, H / KV * Q, ...)."""
    return x.reshape(x.shape[0], kv_heads, -1, x.shape[-1])


def logit_bias(mask: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
    """The term added to the logits, (B, 1 or H, 1 or Q, K): 0 or the gate on visible keys, the lowest number on others.

    Not -inf: a row that sees nothing would be NaN.
    """
    hidden = torch.zeros(mask.shape, dtype=dtype, device=mask.device).masked_fill(~mask, torch.finfo(dtype).min)[
        :, None
    ]
    return hidden if bias is None else hidden + bias[:, None].to(dtype)


def _scores(q: Tensor, k: Tensor) -> Tensor:
    """Logits of folded queries, (B, KV, H / KV * Q, K) float32."""
    return torch.matmul(q * q.shape[-1] ** -0.5, k.transpose(-1, -2)).float()
