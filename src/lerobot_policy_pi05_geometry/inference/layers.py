"""A segment through all layers of a transformer, without modules: what the runner spends its time in.

Shapes: B batch, N tokens of the segment, W width, H heads, KV key/value heads, D head_dim, K keys up to the segment's end.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from ..model.gemma import RMS_EPS
from ..model.segment_cache import SegmentKVCache
from ..model.variants import GemmaVariant
from .fused_weights import FusedLayer


class Modulation(NamedTuple):
    """One adaptive norm at one flow time: 1 + scale, shift (W,) float32, and the residual gate (W,) in the compute dtype."""

    scale: Tensor
    shift: Tensor
    gate: Tensor


LayerModulation = tuple[Modulation, Modulation]  # before attention, before the MLP


class SegmentFrame(NamedTuple):
    """What is the same in every layer of a segment: rotary tables (B, 1, N, D) float32, and the mask of its queries.

    masks: additive, one per layer or the same for all, each (B, 1 or KV, 1 or H / KV * N, K), or None where every key is seen.
    written_out: attention as two products and a softmax instead of PyTorch's fused kernel.
    """

    cos: Tensor
    sin: Tensor
    masks: Sequence[Tensor | None]
    written_out: bool


def write_attention_out(kernels: str, dtype: torch.dtype) -> bool:
    """Which way is faster on this type of device (benchmarks/attention.py)."""
    return kernels == "cpu" and dtype == torch.bfloat16


def run_layers(
    x: Tensor,
    layers: Sequence[FusedLayer],
    variant: GemmaVariant,
    frame: SegmentFrame,
    cache: SegmentKVCache,
    span: slice,
    modulations: Sequence[LayerModulation] | None,
    output: bool,
) -> Tensor:
    """x (B, N, W) through all layers, keys and values into the cache; without `output` the last one stops there.

    span: the segment's columns in the cache. modulations: per layer, or None for plain norms. variant: of the expert, whose
    heads are the VLM's too.
    """
    for index, weights in enumerate(layers):
        modulation = None if modulations is None else modulations[index]
        keys, values = cache.keys[index], cache.values[index]
        last = not output and index == len(layers) - 1
        queries = _attention_inputs(x, weights, variant, frame, modulation, keys, values, span, last)
        if queries is None:
            break
        seen_keys, seen_values = keys[:, :, : span.stop], values[:, :, : span.stop]
        attend = _attend_in_products if frame.written_out else F.scaled_dot_product_attention
        attended = attend(queries, seen_keys, seen_values, frame.masks[index])  # (B, KV, H / KV * N, D)
        heads = attended.unflatten(2, (-1, x.shape[1])).flatten(1, 2)  # (B, H, N, D)
        update = F.linear(heads.transpose(1, 2).flatten(2), weights.out)
        x = _add(x, update, modulation, 0)
        gate, up = F.linear(_norm(x, weights.post_norm, modulation, 1), weights.gate_up).chunk(2, dim=-1)
        x = _add(x, F.linear(F.gelu(gate, approximate="tanh").mul_(up), weights.down), modulation, 1)
    return x


def _attention_inputs(
    x: Tensor,
    weights: FusedLayer,
    variant: GemmaVariant,
    frame: SegmentFrame,
    modulation: LayerModulation | None,
    keys: Tensor,
    values: Tensor,
    span: slice,
    keys_only: bool,
) -> Tensor | None:
    """Write the segment's keys and values to the cache; return its queries (B, KV, H / KV * N, D)."""
    kv = variant.num_kv_heads
    heads = 0 if keys_only else variant.num_heads
    first = variant.num_heads * variant.head_dim if keys_only else 0
    projected = F.linear(_norm(x, weights.norm, modulation, 0), weights.qkv[first:])
    projected = projected.unflatten(-1, (-1, variant.head_dim)).transpose(1, 2)  # (B, heads + 2 KV, N, D)
    turned = _rotate(projected[:, : heads + kv], frame.cos, frame.sin)
    keys[:, :, span].copy_(turned[:, heads:])
    values[:, :, span].copy_(projected[:, heads + kv :])
    if keys_only:
        return None
    return turned[:, :heads].to(x.dtype).unflatten(1, (kv, -1)).flatten(2, 3)


def _attend_in_products(queries: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None) -> Tensor:
    """softmax(q k^T / sqrt(D) + mask) v."""
    scores = torch.matmul(queries * queries.shape[-1] ** -0.5, keys.transpose(-1, -2)).float()
    if mask is not None:
        scores += mask
    return torch.matmul(scores.softmax(dim=-1).to(queries.dtype), values)


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotary positions of x (B, heads, N, D), in float32; sin has the sign of its half."""
    x = x.float()
    first, second = x.chunk(2, dim=-1)
    return torch.addcmul(x * cos, torch.cat([second, first], dim=-1), sin)


def _norm(x: Tensor, weight: Tensor | None, modulation: LayerModulation | None, which: int) -> Tensor:
    if modulation is not None:
        return adaptive_norm(x, modulation[which])
    assert weight is not None
    normed = F.rms_norm(x.float(), (x.shape[-1],), None, RMS_EPS)
    return torch.addcmul(normed, normed, weight).to(x.dtype)  # normed * (1 + weight)


def adaptive_norm(x: Tensor, modulation: Modulation) -> Tensor:
    """adaRMS at a flow time whose modulation is known: (B, N, W) in x's dtype."""
    normed = F.rms_norm(x.float(), (x.shape[-1],), None, RMS_EPS)
    return torch.addcmul(modulation.shift, normed, modulation.scale).to(x.dtype)


def _add(x: Tensor, update: Tensor, modulation: LayerModulation | None, which: int) -> Tensor:
    return x + update if modulation is None else torch.addcmul(x, update, modulation[which].gate)
