"""Attention of the action tokens, read from a policy with forward hooks."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..model.attention import attention_weights
from ..modeling_pi05_geometry import PI05GeometryPolicy


class SuffixAttention(NamedTuple):
    """Attention of the action tokens at one denoising step, averaged over heads, layers and action tokens.

    weights: (B, P + G + S), rows sum to 1. per_layer: (layers, B, P + G + S). lengths: (P, G, S).
    """

    weights: Tensor
    per_layer: Tensor
    lengths: tuple[int, int, int]


@torch.no_grad()
def suffix_attention(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> SuffixAttention:
    """Predict a chunk and return the attention of its last denoising step.

    Forward hooks read the inputs of each attention layer and change nothing.
    """
    network = policy.model.paligemma_with_expert
    suffix_length = policy.config.chunk_size
    seen: dict[int, Tensor] = {}
    total: dict[int, int] = {}

    def hook(index: int):
        def record(_: nn.Module, inputs: tuple) -> None:
            q, k, _, mask, bias = inputs
            # Geometry's queries have fewer keys.
            if q.shape[2] == suffix_length and k.shape[2] >= total.get(index, 0):
                total[index] = k.shape[2]
                seen[index] = attention_weights(q, k, mask, bias).float().mean(dim=(1, 2))

        return record

    handles = [
        layer.self_attn.attention.register_forward_pre_hook(hook(index))
        for index, layer in enumerate(network.expert.layers)
    ]
    try:
        policy.predict_action_chunk(
            dict(batch), runner="plain"
        )  # hooks need modules, which the fast runner does not call
    finally:
        for handle in handles:
            handle.remove()
    per_layer = torch.stack([seen[index] for index in sorted(seen)])
    geometry = policy.geometry.source.num_tokens if policy.geometry is not None else 0
    in_prefix = policy.config.geometry_placement == "prefix"
    lengths = (
        per_layer.shape[-1] - suffix_length - (0 if in_prefix else geometry),
        0 if in_prefix else geometry,
        suffix_length,
    )
    return SuffixAttention(per_layer.mean(dim=0), per_layer, lengths)


@torch.no_grad()
def attention_layout(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> tuple[Tensor, tuple[int, int, int]]:
    """The attention mask as the network applies it to the batch's first sample: (N, N) bool, [query, key], and (P, G, S).

    Read from the masks that the network is given in one uncached pass.
    """
    network = policy.model.paligemma_with_expert
    rows: list[Tensor] = []

    def record(_: nn.Module, args: tuple, kwargs: dict) -> None:
        if not rows:
            embeds = kwargs["inputs_embeds"]
            for mask, tokens in zip(kwargs["attention_mask"], embeds, strict=True):
                if mask is not None:
                    rows.append(mask[0].expand(tokens.shape[1], -1))

    handle = network.register_forward_pre_hook(record, with_kwargs=True)
    try:
        policy.predict_action_chunk(dict(batch), runner="plain", use_cache=False, num_steps=1)
    finally:
        handle.remove()
    total = rows[-1].shape[1]
    square = torch.cat([nn.functional.pad(row, (0, total - row.shape[1])) for row in rows])
    counts = [row.shape[0] for row in rows]
    return square, (counts[0], counts[1] if len(counts) == 3 else 0, counts[-1])
