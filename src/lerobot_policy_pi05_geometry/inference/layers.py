"""A segment through all layers of a transformer, without modules. The runner spends most of its time here.

The arithmetic of norms, rotary positions, attention and residuals is the modules' own (model/norms.py, model/attention.py).

Shapes: B batch, N tokens of the segment, W width, H heads, KV key/value heads, D head_dim, K keys up to the segment's end.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from ..model.attention import apply_rotary, attend_in_products
from ..model.norms import Modulation, add_residual, plain_norm
from ..model.segment_cache import SegmentKVCache
from ..model.variants import GemmaVariant
from .fused_weights import FusedLayer


class FlowTime(NamedTuple):
    """The modulations of all norms of an expert at one flow time.

    scale (1 + scale) and shift are float32, gate is in the compute dtype. Each is (norms, W), or (norms, N, W) where the tokens
    have flow times of their own. The norms are those before attention and before the MLP of every layer, then the final one.
    """

    scale: Tensor
    shift: Tensor
    gate: Tensor

    def by_norm(self) -> list[Modulation]:
        """The modulation of every norm."""
        return [Modulation(*parts) for parts in zip(*(stacked.unbind() for stacked in self), strict=True)]


class SegmentFrame(NamedTuple):
    """The same in every layer of a segment: rotary tables (B, 1, N, D) float32, and the masks of its queries.

    masks: additive, one per layer or the same for all, each (B, 1 or KV, 1 or H / KV * N, K).
    in_products: attention as two products and a softmax instead of PyTorch's fused kernel.
    """

    cos: Tensor
    sin: Tensor
    masks: Sequence[Tensor]
    in_products: bool


def run_layers(
    x: Tensor,
    layers: Sequence[FusedLayer],
    variant: GemmaVariant,
    frame: SegmentFrame,
    cache: SegmentKVCache,
    span: slice,
    modulations: Sequence[Modulation] | None,
    output: bool,
) -> Tensor:
    """x (B, N, W) through all layers, keys and values into the cache; without `output` the last layer stops after them.

    span: the segment's columns in the cache. modulations: of the norms, as in `FlowTime`; None for plain norms. variant: sizes of
    the expert; the VLM has the same heads.
    """
    for index, weights in enumerate(layers):
        before_attention, before_mlp = (None, None) if modulations is None else modulations[2 * index : 2 * index + 2]
        keys, values = cache.keys[index], cache.values[index]
        keys_only = not output and index == len(layers) - 1
        normed = _norm(x, weights.norm, before_attention)
        queries = _attention_inputs(normed, weights, variant, frame, keys, values, span, keys_only)
        if queries is None:
            break
        seen_keys, seen_values = keys[:, :, : span.stop], values[:, :, : span.stop]
        attend = attend_in_products if frame.in_products else F.scaled_dot_product_attention
        attended = attend(queries, seen_keys, seen_values, frame.masks[index])  # (B, KV, H / KV * N, D)
        heads = attended.unflatten(2, (-1, x.shape[1])).flatten(1, 2)  # (B, H, N, D)
        x = _add(x, F.linear(heads.transpose(1, 2).flatten(2), weights.out), before_attention)
        gate, up = F.linear(_norm(x, weights.post_norm, before_mlp), weights.gate_up).chunk(2, dim=-1)
        x = _add(x, F.linear(F.gelu(gate, approximate="tanh").mul_(up), weights.down), before_mlp)
    return x


def _attention_inputs(
    normed: Tensor,
    weights: FusedLayer,
    variant: GemmaVariant,
    frame: SegmentFrame,
    keys: Tensor,
    values: Tensor,
    span: slice,
    keys_only: bool,
) -> Tensor | None:
    """Write the segment's keys and values to the cache; return its queries (B, KV, H / KV * N, D)."""
    kv = variant.num_kv_heads
    heads = 0 if keys_only else variant.num_heads
    first = variant.num_heads * variant.head_dim if keys_only else 0
    projected = F.linear(normed, weights.qkv[first:])
    projected = projected.unflatten(-1, (-1, variant.head_dim)).transpose(1, 2)  # (B, heads + 2 KV, N, D)
    turned = apply_rotary(projected[:, : heads + kv], frame.cos, frame.sin)
    keys[:, :, span].copy_(turned[:, heads:])
    values[:, :, span].copy_(projected[:, heads + kv :])
    if keys_only:
        return None
    return turned[:, :heads].unflatten(1, (kv, -1)).flatten(2, 3)


def _norm(x: Tensor, weight: Tensor | None, modulation: Modulation | None) -> Tensor:
    if modulation is not None:
        return modulation.norm(x)
    assert weight is not None
    return plain_norm(x, weight)


def _add(x: Tensor, update: Tensor, modulation: Modulation | None) -> Tensor:
    return add_residual(x, update, None if modulation is None else modulation.gate)
