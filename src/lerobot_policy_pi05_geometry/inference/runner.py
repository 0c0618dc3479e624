"""A whole action chunk, fast: the network's arithmetic without its modules. `PI05Pytorch.sample_actions` is the reference.

```
   once per weights   joined matrices (fused_weights.py); modulations of all norms at all flow times (layers.py: FlowTime)
   once per chunk     prefill: vision and text as in the plain path, then the prefix through its layers into the cache
                               (meanwhile geometry is measured: side_stream.py)
                      denoise: geometry through its layers into the cache; the suffix's masks, with the gate in them
   once per step               the suffix through its layers: four matrix products, one attention, one cache write a layer
```

Nothing is approximated: in float32 the result equals the plain path's to rounding. `prefill` and `denoise` compute tensors from
tensors and read no value, so a GPU can record them and the host does not wait for it.

A runner holds for the weights that it was built from. sampler.py says when a new one is built.

Shapes: B batch, N tokens of a segment, W width, H heads, KV key/value heads, D head_dim, K keys up to the segment's end.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..model.attention import logit_bias, rotary_table
from ..model.norms import Modulation
from ..model.pi05 import PI05Pytorch
from ..model.precision import compute_in
from ..model.real_time_chunking import Guidance, HardPrefix, make_guidance, make_hard_prefix
from ..model.segment_cache import SegmentKVCache
from ..model.segment_mask import segment_mask
from ..model.segments import GeometryTokens, Segment, SegmentTokens, one_block, segment_positions
from .backend import Backend
from .fused_weights import FusedLayer, fuse
from .layers import FlowTime, SegmentFrame, run_layers
from .side_stream import PendingGeometry
from .weight_versions import WeightVersions


class Observation(NamedTuple):
    """The arguments of `PI05Pytorch.embed_prefix`. An absent camera is None, so no value has to be read to know it."""

    images: Sequence[Tensor | None]
    img_masks: Sequence[Tensor]
    tokens: Tensor
    masks: Tensor


class Context(NamedTuple):
    """What actions are denoised from: the mask of the prefix tokens, (B, P) bool, and the cache."""

    prefix_pad: Tensor
    cache: SegmentKVCache


class GeometryPass(NamedTuple):
    """Geometry as a segment, with its rotary tables and masks."""

    segment: SegmentTokens
    frame: SegmentFrame


class PreparedFlowTime(NamedTuple):
    """The modulations at one flow time, stacked and by norm."""

    flow_time: FlowTime
    modulations: list[Modulation]


class ChunkSettings(NamedTuple):
    """Numbers that a chunk depends on. geometry_tokens: wherever they stand. lengths: of the geometry segment and the suffix."""

    geometry_tokens: int
    lengths: tuple[int, int]
    num_steps: int
    max_guidance_weight: float


class ChunkFunctions(NamedTuple):
    """The two halves of a chunk, for inputs of certain shapes. Geometry goes into one of them, None into the other."""

    prefill: Callable[[Observation, GeometryTokens | None], Context]
    denoise: Callable[[Context, Tensor, GeometryTokens | None, Guidance | HardPrefix | None], Tensor]


class ChunkRunner:
    """Runs a network that is in evaluation mode, with the weights that it has now.

    backend: the device's, unless given. Raises UnsupportedLayerError for layers that the runner cannot compute with (an unmerged
    LoRA), and ValueError for a network in training mode.
    """

    @torch.inference_mode(False)  # the joined weights of inference mode could not be trained any more
    @torch.no_grad()
    def __init__(self, network: PI05Pytorch, backend: Backend | None = None) -> None:
        if network.training:
            raise ValueError("The runner needs a network in evaluation mode; call eval() first.")
        self.network, self.config = network, network.config
        self.device = network.action_in_proj.weight.device
        self.backend = backend or Backend(self.device)
        self._models = {segment: network.paligemma_with_expert.segment_model(segment) for segment in Segment}
        fused: dict[int, list[FusedLayer]] = {}
        for model in self._models.values():
            if id(model) not in fused:
                fused[id(model)] = fuse(model, self.config.dtype)
        self._layers = {segment: fused[id(model)] for segment, model in self._models.items()}
        self._flow_times: dict[tuple[int, tuple[float, ...]], list[PreparedFlowTime]] = {}
        self._side = self.backend.new_side_stream()
        self._weights = WeightVersions(network)

    def is_current(self) -> bool:
        """Whether the network still has the weights that the runner was built from (weight_versions.py), where they were."""
        return self.network.action_in_proj.weight.device == self.device and self._weights.unchanged()

    def tensors(self) -> list[Tensor]:
        """The tensors that outlive a chunk; some of them are the network's own storage (fused_weights.py)."""
        matrices = [m for layers in self._layers.values() for layer in layers for m in vars(layer).values()]
        modulations = [tensor for times in self._flow_times.values() for time in times for tensor in time.flow_time]
        return [tensor for tensor in (*matrices, *modulations) if isinstance(tensor, Tensor)]

    # --- a chunk ------------------------------------------------------------------------------------------------------

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
        geometry: PendingGeometry | None = None,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
    ) -> Tensor:
        """An action chunk (B, S, D) float32; arguments as in `PI05Pytorch.sample_actions`.

        geometry: instead of geom_embs and geom_pad, geometry that is measured while the prefix is computed.
        """
        if noise is None:
            shape = (tokens.shape[0], self.config.chunk_size, self.config.max_action_dim)
            noise = torch.randn(shape, device=tokens.device)
        if geom_embs is not None:
            geometry = PendingGeometry.given(geom_embs, geom_pad)
        observation = Observation(images, img_masks, tokens, masks)
        previous = self._previous_chunk(noise, prev_chunk_left_over, inference_delay, execution_horizon)
        settings = self._settings(noise, num_steps, geometry)
        # Vision and text have an autocast of their own. It caches no casts of weights: each is used once, and the cache would lie
        # in a recorded graph's memory.
        with torch.autocast(self.device.type, enabled=False, cache_enabled=False):
            self.compute_flow_times(settings.num_steps)
            chunk = self._functions(observation, noise, previous, settings)
            early = late = None
            if geometry is not None and self.network.geometry_in_prefix:
                early = geometry.measure()
            self._side.begin_here()
            context = chunk.prefill(observation, early)
            if geometry is not None and early is None:
                late = self._side.run(geometry.measure)
            return chunk.denoise(context, noise, late, previous)

    def _previous_chunk(
        self, noise: Tensor, left_over: Tensor | None, delay: int | None, horizon: int | None
    ) -> Guidance | HardPrefix | None:
        """The inputs of real-time chunking; None if it is off. Where nothing is left over they have no effect."""
        network = self.network
        if not network.rtc_enabled:
            return None
        if network.rtc_mode == "trained":
            return make_hard_prefix(left_over, delay, self.config.rtc_training_max_delay, noise)
        return make_guidance(network.rtc_processor, left_over, delay, horizon, noise)

    def _settings(self, noise: Tensor, num_steps: int | None, geometry: PendingGeometry | None) -> ChunkSettings:
        tokens = 0 if geometry is None else geometry.num_tokens
        lengths = (0 if self.network.geometry_in_prefix else tokens, noise.shape[1])
        rtc = self.network.rtc_processor
        max_weight = 0.0 if rtc is None else rtc.rtc_config.max_guidance_weight
        return ChunkSettings(tokens, lengths, num_steps or self.config.num_inference_steps, max_weight)

    def _functions(
        self, observation: Observation, noise: Tensor, previous: Guidance | HardPrefix | None, settings: ChunkSettings
    ) -> ChunkFunctions:
        """The two halves of a chunk for inputs of these shapes."""
        return ChunkFunctions(partial(self.prefill, settings=settings), partial(self.denoise, settings=settings))

    def prefill(self, observation: Observation, geometry: GeometryTokens | None, settings: ChunkSettings) -> Context:
        """Vision, text and prefix into a new cache; geometry only if it belongs to the prefix."""
        return self.prefill_prefix(self.embed_prefix(observation, geometry), settings.lengths)

    def denoise(
        self,
        context: Context,
        noise: Tensor,
        geometry: GeometryTokens | None,
        previous: Guidance | HardPrefix | None,
        settings: ChunkSettings,
    ) -> Tensor:
        """Actions (B, S, D) from noise of that shape; geometry is None if there is none or the prefix has it."""
        return self.denoise_suffix(context, noise, self.prefill_geometry(context, geometry), previous, settings)

    # --- the parts of the two halves ----------------------------------------------------------------------------------

    def embed_prefix(self, observation: Observation, geometry: GeometryTokens | None = None) -> SegmentTokens:
        """Vision and text, and geometry that belongs to the prefix."""
        with compute_in(self.config.dtype, self.device):
            prefix = self.network.embed_prefix(*observation)
            return prefix if geometry is None else prefix.followed_by(self.network.embed_geometry(*geometry))

    def prefill_prefix(self, prefix: SegmentTokens, lengths: tuple[int, int]) -> Context:
        """The prefix's keys and values in a new cache for geometry and suffix of these lengths."""
        assert prefix.embs is not None
        batch, length = prefix.pad.shape
        cache = self.backend.new_cache(self.network.paligemma_with_expert, batch, (length, *lengths))
        frame = self._frame([prefix.pad, None, None], Segment.PREFIX)
        self._run(Segment.PREFIX, prefix.embs, frame, cache, None, output=False)
        return Context(prefix.pad, cache)

    def prefill_geometry(self, context: Context, geometry: GeometryTokens | None) -> GeometryPass | None:
        """Geometry's keys and values into the cache, unless they follow the flow time."""
        if geometry is None:
            return None
        segment = self.network.embed_geometry(*geometry)
        given = GeometryPass(segment, self._frame([context.prefix_pad, segment.pad, None], Segment.GEOMETRY))
        if not self.network.geometry_follows_time:
            self._write_geometry(context, given, self._flow_times_of(Segment.GEOMETRY, (0.0,))[0].modulations)
        return given

    def denoise_suffix(
        self,
        context: Context,
        x_t: Tensor,
        geometry: GeometryPass | None,
        previous: Guidance | HardPrefix | None,
        settings: ChunkSettings,
    ) -> Tensor:
        """Integrate the flow from noise x_t (B, S, D) over a filled cache."""
        network, times = self.network, _step_times(settings.num_steps)
        dt = -1.0 / settings.num_steps
        suffix_pad = torch.ones(x_t.shape[:2], dtype=torch.bool, device=x_t.device)
        geometry_pad = None if geometry is None else geometry.segment.pad
        frame = self._frame([context.prefix_pad, geometry_pad, suffix_pad], Segment.SUFFIX)
        hard = previous if isinstance(previous, HardPrefix) else None
        clean = None if hard is None else self._flow_times_of(Segment.SUFFIX, (0.0,))[0]
        geometry_times = self._flow_times_of(Segment.GEOMETRY, times) if network.geometry_follows_time else None
        for step, prepared in enumerate(self._flow_times_of(Segment.SUFFIX, times)):
            modulations = prepared.modulations
            if geometry is not None and geometry_times is not None:
                self._write_geometry(context, geometry, geometry_times[step].modulations)
            if hard is not None and clean is not None:
                x_t = hard.impose(x_t)
                modulations = _by_token(hard.mask, clean.flow_time, prepared.flow_time).by_norm()
            embs = network.action_in_proj(x_t)
            x = self._run(Segment.SUFFIX, embs, frame, context.cache, modulations, output=True)
            velocity = network.action_out_proj(modulations[-1].norm(x))
            if isinstance(previous, Guidance):
                velocity = previous.correct(velocity, x_t, times[step], settings.max_guidance_weight)
            x_t = torch.add(x_t, velocity, alpha=dt)
        return x_t if hard is None else hard.impose(x_t)

    def _write_geometry(self, context: Context, geometry: GeometryPass, modulations: Sequence[Modulation]) -> None:
        assert geometry.segment.embs is not None
        self._run(Segment.GEOMETRY, geometry.segment.embs, geometry.frame, context.cache, modulations, output=False)

    def _run(
        self,
        segment: Segment,
        embs: Tensor,
        frame: SegmentFrame,
        cache: SegmentKVCache,
        modulations: Sequence[Modulation] | None,
        output: bool,
    ) -> Tensor:
        """Embeddings (B, N, W) of a segment through its layers, in the compute dtype."""
        x, layers = embs.to(self.config.dtype), self._layers[segment]
        return run_layers(x, layers, self.config.expert, frame, cache, cache.span(segment), modulations, output)

    # --- the same in every chunk --------------------------------------------------------------------------------------

    def compute_flow_times(self, num_steps: int) -> None:
        """Compute the modulations that a chunk of so many denoising steps needs, before it is recorded."""
        network, times = self.network, _step_times(num_steps)
        self._flow_times_of(Segment.SUFFIX, times)
        if network.rtc_enabled and network.rtc_mode == "trained":
            self._flow_times_of(Segment.SUFFIX, (0.0,))
        if self.config.geometry is not None and not network.geometry_in_prefix:
            self._flow_times_of(Segment.GEOMETRY, times if network.geometry_follows_time else (0.0,))

    @torch.inference_mode(False)
    @torch.no_grad()
    def _flow_times_of(self, segment: Segment, times: tuple[float, ...]) -> list[PreparedFlowTime]:
        """The modulations of a segment's norms at these T flow times."""
        model = self._models[segment]
        key = id(model), times
        if key not in self._flow_times:
            # Filled on the device, not copied from the host, which could not be recorded.
            flow_times = torch.cat([torch.full((1,), time, device=self.device) for time in times])
            cond = self.network.embed_time(flow_times)  # (T, W)
            norms = [norm for x in model.layers for norm in (x.input_layernorm, x.post_attention_layernorm)]
            given = torch.stack([norm.dense(cond) for norm in (*norms, model.norm)], dim=1)  # (T, norms, 3 W)
            scale, shift, gate = Modulation.of(given)
            gate = gate.to(self.config.dtype)
            found = [FlowTime(*rows) for rows in zip(scale, shift, gate, strict=True)]
            self._flow_times[key] = [PreparedFlowTime(flow_time, flow_time.by_norm()) for flow_time in found]
        return self._flow_times[key]

    # --- the same in every layer --------------------------------------------------------------------------------------

    def _frame(self, pads: list[Tensor | None], segment: Segment) -> SegmentFrame:
        """Rotary tables and masks of a segment. pads: (B, N) bool of all segments up to it, None for absent ones."""
        rule = self.config.geometry.positions if self.config.geometry else "sequential"
        positions = segment_positions(pads, rule)[segment]
        assert positions is not None
        cos, sin = rotary_table(positions, self.config.expert.head_dim)
        return SegmentFrame(cos, sin, self._masks(segment, pads), self.backend.attention_in_products(self.config.dtype))

    def _masks(self, segment: Segment, pads: Sequence[Tensor | None]) -> list[Tensor]:
        """Additive masks of a segment's folded queries, per layer: (B, 1, 1, K), or with the gate (B, KV, H / KV * N, K)."""
        seen = segment_mask(segment, pads, [None if pad is None else one_block(pad.shape[1]) for pad in pads])
        expert, gate = self.config.expert, self.network.paligemma_with_expert.geometry_gate
        dtype = self.backend.mask_dtype(self.config.dtype)
        prefix, geometry, suffix = (0 if pad is None else pad.shape[1] for pad in pads)
        if segment is not Segment.SUFFIX or gate is None or not geometry:
            return [logit_bias(seen, None, dtype)] * expert.depth
        masks = []
        for layer in range(expert.depth):
            bias = logit_bias(seen, gate(layer, prefix, geometry, suffix), dtype)  # (B, H, 1, K)
            rows = bias.expand(-1, -1, suffix, -1).unflatten(1, (expert.num_kv_heads, -1))
            masks.append(rows.flatten(2, 3))
        return masks


def _step_times(num_steps: int) -> tuple[float, ...]:
    """Flow time of every denoising step, from 1 downwards."""
    return tuple(1.0 - step / num_steps for step in range(num_steps))


def _by_token(mask: Tensor, clean: FlowTime, now: FlowTime) -> FlowTime:
    """Modulations per token (norms, N, W): `clean` where the mask (N,) is True, else `now`."""
    where = mask[:, None]
    return FlowTime(*(torch.where(where, a[:, None], b[:, None]) for a, b in zip(clean, now, strict=True)))


def observation_key(*inputs: Any) -> tuple:
    """Shapes and dtypes of the tensors among `inputs`, which are leaves."""
    return tuple((x.shape, x.dtype) if isinstance(x, Tensor) else None for x in inputs)
