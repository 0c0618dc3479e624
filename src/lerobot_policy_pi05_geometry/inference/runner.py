"""A whole action chunk, fast: the network's arithmetic without its modules. `PI05Pytorch.sample_actions` is the reference.

```
   once per weights   fused matrices (fused_weights.py)
   once per chunk     look: vision and text as in the plain path, then the prefix through its layers into the cache
                            (meanwhile geometry is measured: side_stream.py)
                      act:  geometry through its layers into the cache; the suffix's masks, with the gate in them
   once per step            the suffix through its layers: four matrix products, one attention, one cache write a layer
```

What depends on the flow time alone, the modulations of all norms, is computed for all steps at once; on a CPU it is kept until
weights change, on a GPU it is part of `act`, since to see whether they changed is to wait. What depends on the observation alone
is computed once per chunk and not in every layer. Nothing is approximated: in float32 the result is the plain path's to rounding.
`look` and `act` compute tensors from tensors without looking at a value, so a GPU can record them and need not be waited for.

Shapes: B batch, N tokens of a segment, W width, H heads, KV key/value heads, D head_dim, K keys up to the segment's end.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from ..model.attention import rotary_table
from ..model.pi05 import PI05Pytorch
from ..model.precision import Float32Linear, compute_in
from ..model.segment_cache import SegmentKVCache
from ..model.segment_mask import segment_mask
from ..model.segments import GeometryTokens, Segment, SegmentTokens, one_block, segment_positions
from .fused_weights import FusedLayer, Weights, copied, fuse
from .layers import LayerModulation, Modulation, SegmentFrame, adaptive_norm, run_layers, write_attention_out
from .side_stream import PendingGeometry, SideStream


class Observation(NamedTuple):
    """What `PI05Pytorch.embed_prefix` takes. An absent camera is None, so which are there is known without a look at a value."""

    images: Sequence[Tensor | None]
    img_masks: Sequence[Tensor]
    tokens: Tensor
    masks: Tensor


class Context(NamedTuple):
    """What actions are denoised from: which prefix tokens are real, (B, P) bool, and the cache."""

    prefix_pad: Tensor
    cache: SegmentKVCache


class FlowTime(NamedTuple):
    """What modulates an expert at one flow time: every layer, and the final norm."""

    layers: Sequence[LayerModulation]
    last: Modulation


class Chunk(NamedTuple):
    """The two halves of a chunk, for inputs of certain shapes. Geometry goes into one of them, and None into the other."""

    look: Callable[[Observation, GeometryTokens | None], Context]
    act: Callable[[Context, Tensor, GeometryTokens | None], Tensor]


def why_not(network: PI05Pytorch) -> str | None:
    """Why the runner cannot run this network, as the rest of a sentence; None if it can."""
    geometry = network.config.geometry
    if geometry is not None and geometry.time == "denoise":
        return "geometry_time=denoise recomputes geometry at every step"
    return None


class ChunkRunner:
    """Runs a network. Raises NotPlainError for projections that are not plain linear layers (an unmerged LoRA)."""

    def __init__(self, network: PI05Pytorch) -> None:
        self.network, self.config = network, network.config
        self._build()

    def refresh(self) -> None:
        """Build anew if the network has changed: training went on, a LoRA came or was merged, or it moved elsewhere."""
        if self._weights.stale():
            self._build()

    @torch.inference_mode(False)  # or the joined weights could never again be trained
    @torch.no_grad()
    def _build(self) -> None:
        """The weights as the runner wants them."""
        network, dtype = self.network.paligemma_with_expert, self.config.dtype
        self.device = self.network.action_in_proj.weight.device
        models = {segment: network.segment_model(segment) for segment in Segment}
        fused: dict[int, list[FusedLayer]] = {}
        read: list[Tensor] = []
        for model in {id(model): model for model in models.values()}.values():
            fused[id(model)] = fuse(model, dtype)
            read += copied(model, dtype)
        self._models = models
        self._layers = {segment: fused[id(model)] for segment, model in models.items()}
        self._side = SideStream(self.device)
        self._kept: dict[tuple[Segment, int], list[FlowTime]] = {}
        if self._may_look:  # what modulations are kept of: the norms' linear maps and the flow time's
            linears = [module for module in self.network.modules() if isinstance(module, Float32Linear)]
            read += [parameter.detach() for linear in linears for parameter in linear.parameters()]
        self._weights = Weights(self.network, read)

    def tensors(self) -> list[Tensor]:
        """All that is kept between chunks; some of it is the network's own storage (fused_weights.py)."""
        matrices = (m for layers in self._layers.values() for layer in layers for m in vars(layer).values())
        return [tensor for tensor in (*matrices, *tree_leaves(list(self._kept.values()))) if isinstance(tensor, Tensor)]

    def _modulations(self, segment: Segment, times: Sequence[float]) -> list[FlowTime]:
        """What modulates an expert at these T flow times."""
        # Filled on the device: what is fetched from the host cannot be recorded.
        flow_times = torch.cat([torch.full((1,), time, device=self.device) for time in times])
        cond, model = self.network.embed_time(flow_times), self._models[segment]  # (T, W)
        norms = [norm for x in model.layers for norm in (x.input_layernorm, x.post_attention_layernorm)]
        given = torch.stack([norm.dense(cond) for norm in (*norms, model.norm)], dim=1)  # (T, norms, 3 W)
        scale, shift, gate = given.chunk(3, dim=-1)
        found = []
        for rows in zip(1.0 + scale, shift, gate.to(self.config.dtype), strict=True):
            *each, last = (Modulation(*row) for row in zip(*rows, strict=True))
            found.append(FlowTime(list(zip(each[::2], each[1::2], strict=True)), last))
        return found

    def _schedule(self, segment: Segment, num_steps: int) -> list[FlowTime]:
        """Of the suffix at every denoising step; of geometry at the clean end of the flow."""
        key = segment, num_steps
        if key in self._kept:
            return self._kept[key]
        times = [1.0 - step / num_steps for step in range(num_steps)] if segment is Segment.SUFFIX else [0.0]
        schedule = self._modulations(segment, times)
        if self._may_look:
            self._kept[key] = schedule
        return schedule

    def __call__(self, *observation: Any, **kwargs: Any) -> Tensor:
        """An action chunk (B, S, D) float32 from the weights as they are now; arguments as in `sample`."""
        self.refresh()
        return self.sample(*observation, **kwargs)

    @torch.no_grad()
    def sample(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        noise: Tensor | None = None,
        num_steps: int | None = None,
        geom_embs: Tensor | None = None,
        geom_pad: Tensor | None = None,
        geometry: PendingGeometry | None = None,
    ) -> Tensor:
        """An action chunk from the weights as they were last looked at; arguments as in `PI05Pytorch.sample_actions`.

        geometry: instead of geom_embs and geom_pad, what measures them once vision and prefix are on their way.
        """
        if noise is None:
            shape = (tokens.shape[0], self.config.chunk_size, self.config.max_action_dim)
            noise = torch.randn(shape, device=tokens.device)
        if geom_embs is not None:
            geometry = PendingGeometry.given(geom_embs, geom_pad)
        observation = Observation(images, img_masks, tokens, masks)
        num_tokens = 0 if geometry is None else geometry.num_tokens
        # None of the caller's autocast: vision and text have their own. It keeps no casts of weights, which are used once, and
        # which would lie in a recorded graph's memory.
        with torch.autocast(self.device.type, enabled=False, cache_enabled=False):
            chunk = self._chunk(observation, noise, num_steps or self.config.num_inference_steps, num_tokens)
            early = late = None
            if geometry is not None and self.network.geometry_in_prefix:
                early = geometry.measure()
            self._side.begin_here()
            context = chunk.look(observation, early)
            if geometry is not None and early is None:
                late = self._side.run(geometry.measure)
            return chunk.act(context, noise, late)

    def _chunk(self, observation: Observation, noise: Tensor, num_steps: int, num_tokens: int) -> Chunk:
        """How to compute a chunk from such inputs. num_tokens: of geometry."""
        room = (0 if self.network.geometry_in_prefix else num_tokens, noise.shape[1])
        return Chunk(partial(self.look, room=room), partial(self.act, num_steps=num_steps))

    # --- the two halves, and what they consist of ---------------------------------------------------------------------

    def look(self, observation: Observation, geometry: GeometryTokens | None, room: tuple[int, int]) -> Context:
        """Vision, text and prefix; geometry only if it belongs there. room: tokens of the geometry segment and the suffix."""
        return self.prefill(self.embed(observation, geometry), room)

    def act(self, context: Context, noise: Tensor, geometry: GeometryTokens | None, num_steps: int) -> Tensor:
        """Actions (B, S, D) from noise of that shape; geometry is None if there is none or the prefix has it."""
        return self.denoise(context, noise, self.prefill_geometry(context, geometry), num_steps)

    def embed(self, observation: Observation, geometry: GeometryTokens | None = None) -> SegmentTokens:
        """Vision and text, and the geometry that belongs into the prefix."""
        with compute_in(self.config.dtype, self.device):
            prefix = self.network.embed_prefix(*observation)
            return prefix if geometry is None else prefix.followed_by(self.network.embed_geometry(*geometry))

    def prefill(self, prefix: SegmentTokens, room: tuple[int, int]) -> Context:
        """The prefix's keys and values in a new cache that has room for the other two segments."""
        assert prefix.embs is not None
        batch, length = prefix.pad.shape
        cache = self._make_cache(batch, (length, *room))
        frame = self._frame([prefix.pad, None, None], Segment.PREFIX)
        self._run(Segment.PREFIX, prefix.embs, frame, cache, None, output=False)
        return Context(prefix.pad, cache)

    def _make_cache(self, batch: int, lengths: tuple[int, int, int]) -> SegmentKVCache:
        return self.network.paligemma_with_expert.make_cache(batch, lengths, self.device)

    def prefill_geometry(self, context: Context, geometry: GeometryTokens | None) -> Tensor | None:
        """Keys and values of geometry, if there is any, into the cache. Returns its mask."""
        if geometry is None:
            return None
        segment = self.network.embed_geometry(*geometry)
        assert segment.embs is not None
        frame = self._frame([context.prefix_pad, segment.pad, None], Segment.GEOMETRY)
        clean = self._schedule(Segment.GEOMETRY, 1)[0].layers
        self._run(Segment.GEOMETRY, segment.embs, frame, context.cache, clean, output=False)
        return segment.pad

    def denoise(self, context: Context, x_t: Tensor, geometry_pad: Tensor | None, num_steps: int) -> Tensor:
        """Integrate the flow from noise x_t (B, S, D) over a filled cache."""
        network, dt = self.network, -1.0 / num_steps
        suffix_pad = torch.ones(x_t.shape[:2], dtype=torch.bool, device=x_t.device)
        frame = self._frame([context.prefix_pad, geometry_pad, suffix_pad], Segment.SUFFIX)
        for layers, last in self._schedule(Segment.SUFFIX, num_steps):
            x = self._run(Segment.SUFFIX, network.action_in_proj(x_t), frame, context.cache, layers, output=True)
            x_t = torch.add(x_t, network.action_out_proj(adaptive_norm(x, last)), alpha=dt)
        return x_t

    def _run(
        self,
        segment: Segment,
        embs: Tensor,
        frame: SegmentFrame,
        cache: SegmentKVCache,
        modulations: Sequence[LayerModulation] | None,
        output: bool,
    ) -> Tensor:
        """Embeddings (B, N, W) of a segment through its layers, in the compute dtype."""
        x, layers = embs.to(self.config.dtype), self._layers[segment]
        return run_layers(x, layers, self.config.expert, frame, cache, cache.span(segment), modulations, output)

    # --- what is the same in every layer ------------------------------------------------------------------------------

    def _frame(self, pads: list[Tensor | None], segment: Segment) -> SegmentFrame:
        """Positions and masks of a segment. pads: (B, N) bool of all segments up to it, None for those that are not there."""
        rule = self.config.geometry.positions if self.config.geometry else "sequential"
        positions = segment_positions(pads, rule)[segment]
        assert positions is not None
        cos, sin = rotary_table(positions, self.config.expert.head_dim)
        cos, sin = torch.cat([cos, cos], dim=-1), torch.cat([-sin, sin], dim=-1)
        written_out = write_attention_out(self.kernels, self.config.dtype)
        return SegmentFrame(cos[:, None], sin[:, None], self._masks(segment, pads), written_out)

    def _masks(self, segment: Segment, pads: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Additive masks of a segment, per layer."""
        atts = [None if pad is None else one_block(pad.shape[1]) for pad in pads]
        seen = segment_mask(segment, pads, atts)  # (B, 1, K)
        depth, geometry_pad = self.config.expert.depth, pads[Segment.GEOMETRY]
        gate = self.network.paligemma_with_expert.geometry_gate
        # A float32 mask keeps the gate's digits; CUDA has no fast kernel for one beside bf16 queries.
        dtype = torch.float32 if self.kernels == "cpu" else self.config.dtype
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
        return [None if self._may_look and bool(seen.all()) else hidden] * depth

    @property
    def kernels(self) -> str:
        """Type of the device whose kernels decide how things are computed."""
        return self.device.type

    @property
    def _may_look(self) -> bool:
        """Whether values may be looked at: on a GPU, to look is to wait."""
        return self.device.type == "cpu"
