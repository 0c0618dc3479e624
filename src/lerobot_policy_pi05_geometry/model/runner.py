"""A whole action chunk, fast: the network's arithmetic without its modules. `PI05Pytorch.sample_actions` is the reference.

```
   once per weights      fused matrices (fused.py); all modulations of all denoising steps, and of geometry's flow time 0
   once per chunk        vision and text as in the plain path; masks with the gate in them; rotary tables; prefix, then geometry,
                         through their layers into the cache
   once per step         the suffix through its layers: four matrix products, one attention, one cache write a layer
```

What depends on the flow time alone is computed once and not at every step, what depends on the observation alone once per chunk
and not in every layer. Nothing is approximated: in float32 the result is the plain path's to rounding.

Shapes: B batch, N tokens of a segment, W width, H heads, KV key/value heads, D head_dim, K keys up to the segment's end.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves

from .attention import rotary_table
from .cache import SegmentKVCache
from .fused import FusedLayer, Weights, fuse
from .gemma import RMS_EPS, AdaRMSNorm, GemmaModel
from .layout import Segment, one_block, segment_mask, segment_positions
from .pi05 import PI05Pytorch, SegmentTokens
from .precision import compute_in


class Modulation(NamedTuple):
    """One adaptive norm at one flow time: 1 + scale, shift (W,) float32, and the residual gate (W,) in the compute dtype."""

    scale: Tensor
    shift: Tensor
    gate: Tensor


LayerModulation = tuple[Modulation, Modulation]  # before attention, before the MLP


class SegmentFrame(NamedTuple):
    """What is the same in every layer of a segment: rotary tables (B, 1, N, D) float32, and the mask of its queries.

    masks: additive, one per layer or the same for all, each (B, 1 or KV, 1 or H / KV * N, K), or None where every key is seen.
    """

    cos: Tensor
    sin: Tensor
    masks: Sequence[Tensor | None]


def why_not(network: PI05Pytorch) -> str | None:
    """Why the runner cannot run this network, as the rest of a sentence; None if it can."""
    geometry = network.config.geometry
    if geometry is not None and geometry.time == "denoise":
        return "geometry_time=denoise recomputes geometry at every step"
    return None


class ChunkRunner:
    """Runs a network. Raises TypeError for projections that are not plain linear layers (an unmerged LoRA)."""

    def __init__(self, network: PI05Pytorch) -> None:
        self.network, self.config = network, network.config
        self._build()

    def refresh(self) -> None:
        """Build anew if the network has changed: training went on, a LoRA came or was merged, or it moved elsewhere."""
        if self._weights.stale():
            self._build()

    @torch.no_grad()
    def _build(self) -> None:
        """Everything that depends on the weights alone."""
        network, dtype = self.network.paligemma_with_expert, self.config.dtype
        models = {segment: network.segment_model(segment) for segment in Segment}
        fused: dict[int, list[FusedLayer]] = {}
        for model in models.values():
            if id(model) not in fused:
                fused[id(model)] = fuse(model, dtype)
        self._models = models
        self._layers = {segment: fused[id(model)] for segment, model in models.items()}
        self._steps: dict[int, list[tuple[list[LayerModulation], Modulation]]] = {}
        self._clean = self._modulations(models[Segment.GEOMETRY], 0.0)[0]
        self._weights = Weights(self.network)

    def tensors(self) -> list[Tensor]:
        """All that is kept between chunks; some of it is the network's own storage (fused.py)."""
        leaves = tree_leaves([self._clean, *self._steps.values()])
        matrices = (m for layers in self._layers.values() for layer in layers for m in vars(layer).values())
        return [tensor for tensor in (*matrices, *leaves) if isinstance(tensor, Tensor)]

    def _modulations(self, model: GemmaModel, time: float) -> tuple[list[LayerModulation], Modulation]:
        """Of every layer of an expert and of its final norm, at one flow time."""
        device = self.network.action_in_proj.weight.device
        cond = self.network.embed_time(torch.tensor([time], dtype=torch.float32, device=device))

        def at(norm: nn.Module | Tensor) -> Modulation:
            assert isinstance(norm, AdaRMSNorm)
            scale, shift, gate = norm.dense(cond)[0].chunk(3)
            return Modulation(1.0 + scale, shift, gate.to(self.config.dtype))

        layers = [(at(layer.input_layernorm), at(layer.post_attention_layernorm)) for layer in model.layers]
        return layers, at(model.norm)

    def _schedule(self, num_steps: int) -> list[tuple[list[LayerModulation], Modulation]]:
        """Modulations of the suffix at every denoising step; kept for each number of steps that was asked for."""
        if num_steps not in self._steps:
            times = [1.0 - step / num_steps for step in range(num_steps)]
            self._steps[num_steps] = [self._modulations(self._models[Segment.SUFFIX], time) for time in times]
        return self._steps[num_steps]

    @torch.no_grad()
    def __call__(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        noise: Tensor | None = None,
        num_steps: int | None = None,
        geom_embs: Tensor | None = None,
        geom_pad: Tensor | None = None,
    ) -> Tensor:
        """An action chunk (B, S, D) float32; arguments as in `PI05Pytorch.sample_actions`."""
        self.refresh()
        if noise is None:
            shape = (tokens.shape[0], self.config.chunk_size, self.config.max_action_dim)
            noise = torch.randn(shape, device=tokens.device)
        segments, frames, cache = self.prepare(images, img_masks, tokens, masks, noise, geom_embs, geom_pad)
        self.prefill(Segment.PREFIX, segments, frames, cache)
        self.prefill(Segment.GEOMETRY, segments, frames, cache)
        return self.denoise(noise, num_steps or self.config.num_inference_steps, frames, cache)

    def prepare(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        noise: Tensor,
        geom_embs: Tensor | None,
        geom_pad: Tensor | None,
    ) -> tuple[list[SegmentTokens | None], dict[Segment, SegmentFrame], SegmentKVCache]:
        """Vision and text; what is the same in every layer; an empty cache."""
        with compute_in(self.config.dtype, tokens.device):
            prefix, geometry = self.network._context(images, img_masks, tokens, masks, geom_embs, geom_pad, None)
        pad = torch.ones(noise.shape[:2], dtype=torch.bool, device=noise.device)
        segments = [prefix, geometry, SegmentTokens(None, pad, one_block(noise.shape[1]))]
        return segments, *self._frames(segments)

    def prefill(
        self,
        segment: Segment,
        segments: Sequence[SegmentTokens | None],
        frames: dict[Segment, SegmentFrame],
        cache: SegmentKVCache,
    ) -> None:
        """Keys and values of prefix or geometry into the cache; nothing for a segment that is not there."""
        given = segments[segment]
        if given is None or given.embs is None:
            return
        modulations = self._clean if segment is Segment.GEOMETRY else None
        self._run(segment, given.embs.to(self.config.dtype), frames, cache, modulations, output=False)

    def denoise(
        self, x_t: Tensor, num_steps: int, frames: dict[Segment, SegmentFrame], cache: SegmentKVCache
    ) -> Tensor:
        """Integrate the flow from noise x_t (B, S, D) over a filled cache."""
        network, dt = self.network, -1.0 / num_steps
        for layers, last in self._schedule(num_steps):
            embs = network.action_in_proj(x_t).to(self.config.dtype)
            x = self._run(Segment.SUFFIX, embs, frames, cache, layers, output=True)
            x_t = torch.add(x_t, network.action_out_proj(_adaptive_norm(x, last)), alpha=dt)
        return x_t

    # --- what is the same in every layer ------------------------------------------------------------------------------

    def _frames(self, segments: list[SegmentTokens | None]) -> tuple[dict[Segment, SegmentFrame], SegmentKVCache]:
        """Positions and masks of all segments, and an empty cache."""
        pads = [None if s is None else s.pad for s in segments]
        atts = [None if s is None else s.att for s in segments]
        rule = self.config.geometry.positions if self.config.geometry else "sequential"
        positions = segment_positions(pads, rule)
        frames = {}
        for segment in Segment:
            place = positions[segment]
            if place is not None:
                cos, sin = rotary_table(place, self.config.expert.head_dim)
                frames[segment] = SegmentFrame(
                    torch.cat([cos, cos], dim=-1)[:, None],
                    torch.cat([-sin, sin], dim=-1)[:, None],
                    self._masks(segment, segment_mask(segment, pads, atts), pads),
                )
        lengths = [0 if pad is None else pad.shape[1] for pad in pads]
        first = pads[Segment.SUFFIX]
        assert first is not None
        return frames, self.network.paligemma_with_expert.make_cache(first.shape[0], lengths, first.device)

    def _masks(self, segment: Segment, seen: Tensor, pads: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Additive masks of a segment, per layer. seen: (B, 1, K) bool."""
        depth, geometry_pad = self.config.expert.depth, pads[Segment.GEOMETRY]
        gate = self.network.paligemma_with_expert.geometry_gate
        # A float32 mask keeps the gate's digits; CUDA has no fast kernel for one beside bf16 queries.
        dtype = torch.float32 if self._kernels(seen) == "cpu" else self.config.dtype
        hidden = torch.zeros(seen.shape, dtype=dtype, device=seen.device).masked_fill(~seen, torch.finfo(dtype).min)
        hidden = hidden[:, None]  # (B, 1, 1, K)
        if segment is Segment.SUFFIX and gate is not None and geometry_pad is not None:
            suffix = pads[Segment.SUFFIX]
            assert suffix is not None
            queries, start = suffix.shape[1], seen.shape[2] - suffix.shape[1] - geometry_pad.shape[1]
            heads = self.config.expert.num_kv_heads
            masks: list[Tensor | None] = []
            for layer in range(depth):
                bias = gate(layer, start, geometry_pad.shape[1], queries).to(dtype)  # (H, K)
                rows = bias.unflatten(0, (heads, -1))[:, :, None].expand(-1, -1, queries, -1).flatten(1, 2)
                masks.append(hidden + rows)
            return masks
        return [None if self._hides_nothing(seen) else hidden] * depth

    def _hides_nothing(self, seen: Tensor) -> bool:
        """Whether a segment needs no mask."""
        return self._kernels(seen) == "cpu" and bool(seen.all())  # on a GPU, to look would be to wait

    def _kernels(self, tensor: Tensor) -> str:
        """Type of the device whose kernels decide how things are computed."""
        return tensor.device.type

    # --- layers -------------------------------------------------------------------------------------------------------

    def _run(
        self,
        segment: Segment,
        x: Tensor,
        frames: dict[Segment, SegmentFrame],
        cache: SegmentKVCache,
        modulations: list[LayerModulation] | None,
        output: bool,
    ) -> Tensor:
        """A segment through all layers, keys and values into the cache; without `output` the last one stops there."""
        frame, layers, span = frames[segment], self._layers[segment], cache.span(segment)
        for index, weights in enumerate(layers):
            modulation = None if modulations is None else modulations[index]
            keys, values = cache.keys[index], cache.values[index]
            last = not output and index == len(layers) - 1
            queries = self._attention_inputs(x, weights, frame, modulation, keys, values, span, last)
            if queries is None:
                break
            seen_keys, seen_values = keys[:, :, : span.stop], values[:, :, : span.stop]
            attended = self._attend(queries, seen_keys, seen_values, frame.masks[index])  # (B, KV, H / KV * N, D)
            heads = attended.unflatten(2, (-1, x.shape[1])).flatten(1, 2)  # (B, H, N, D)
            update = F.linear(heads.transpose(1, 2).flatten(2), weights.out)
            x = _add(x, update, modulation, 0)
            gate, up = F.linear(_norm(x, weights.post_norm, modulation, 1), weights.gate_up).chunk(2, dim=-1)
            x = _add(x, F.linear(F.gelu(gate, approximate="tanh").mul_(up), weights.down), modulation, 1)
        return x

    def _attention_inputs(
        self,
        x: Tensor,
        weights: FusedLayer,
        frame: SegmentFrame,
        modulation: LayerModulation | None,
        keys: Tensor,
        values: Tensor,
        span: slice,
        keys_only: bool,
    ) -> Tensor | None:
        """Write the segment's keys and values to the cache; return its queries (B, KV, H / KV * N, D)."""
        expert = self.config.expert
        kv = expert.num_kv_heads
        heads = 0 if keys_only else expert.num_heads
        matrix = weights.qkv[expert.num_heads * expert.head_dim :] if keys_only else weights.qkv
        projected = F.linear(_norm(x, weights.norm, modulation, 0), matrix)
        projected = projected.unflatten(-1, (-1, expert.head_dim)).transpose(1, 2)  # (B, heads + 2 KV, N, D)
        turned = _rotate(projected[:, : heads + kv], frame.cos, frame.sin)
        keys[:, :, span].copy_(turned[:, heads:])
        values[:, :, span].copy_(projected[:, heads + kv :])
        if keys_only:
            return None
        return turned[:, :heads].to(x.dtype).unflatten(1, (kv, -1)).flatten(2, 3)

    def _attend(self, queries: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None) -> Tensor:
        """softmax(q k^T / sqrt(D) + mask) v, by whichever way is faster (benchmarks/attention.py)."""
        if self._kernels(queries) != "cpu" or queries.dtype != torch.bfloat16:
            return F.scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
        scores = torch.matmul(queries * queries.shape[-1] ** -0.5, keys.transpose(-1, -2)).float()
        if mask is not None:
            scores += mask
        return torch.matmul(scores.softmax(dim=-1).to(queries.dtype), values)


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotary positions of x (B, heads, N, D), in float32; sin has the sign of its half."""
    x = x.float()
    first, second = x.chunk(2, dim=-1)
    return torch.addcmul(x * cos, torch.cat([second, first], dim=-1), sin)


def _norm(x: Tensor, scale: Tensor | None, modulation: LayerModulation | None, which: int) -> Tensor:
    if modulation is not None:
        return _adaptive_norm(x, modulation[which])
    assert scale is not None
    return (F.rms_norm(x.float(), (x.shape[-1],), None, RMS_EPS) * scale).to(x.dtype)


def _adaptive_norm(x: Tensor, modulation: Modulation) -> Tensor:
    normed = F.rms_norm(x.float(), (x.shape[-1],), None, RMS_EPS)
    return torch.addcmul(modulation.shift, normed, modulation.scale).to(x.dtype)


def _add(x: Tensor, update: Tensor, modulation: LayerModulation | None, which: int) -> Tensor:
    return x + update if modulation is None else torch.addcmul(x, update, modulation[which].gate)
