"""π0.5 with a geometry segment: embed, train, sample. Names and argument order are those of π0.5 code bases.

Shapes: B batch, V cameras, L prompt tokens, P|G|S tokens of prefix, geometry and suffix, D max_action_dim, W_vlm and
W expert width.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.utils.device_utils import get_safe_dtype
from torch import Tensor, nn

from .config import NetworkConfig, RtcMode
from .paligemma_with_expert import PaliGemmaWithExpert
from .precision import Float32Linear, compute_in
from .real_time_chunking import HardPrefix, make_hard_prefix, require_delay
from .segment_cache import SegmentKVCache
from .segment_mask import segment_mask
from .segments import AttMasks, Segment, SegmentTokens, att_masks_of, one_block, segment_positions


class PI05Pytorch(nn.Module):
    """The network. Images in [-1, 1], actions normalised, everything a tensor; losses and actions out."""

    def __init__(self, config: NetworkConfig, rtc_processor=None) -> None:
        super().__init__()
        self.config = config
        self.rtc_processor = rtc_processor
        self.rtc_mode: RtcMode = "guided"
        width = config.expert.width
        self.paligemma_with_expert = PaliGemmaWithExpert(config)
        self.action_in_proj = Float32Linear(config.max_action_dim, width)
        self.action_out_proj = Float32Linear(width, config.max_action_dim)
        self.time_mlp_in = Float32Linear(width, width)
        self.time_mlp_out = Float32Linear(width, width)

    @property
    def geometry_width(self) -> int:
        """Width that geometry tokens must have: the expert's, or the VLM's if they stand in its prefix."""
        return self.config.paligemma.gemma.width if self.geometry_in_prefix else self.config.expert.width

    @property
    def rtc_enabled(self) -> bool:
        """Whether chunks continue the previous one."""
        return self.rtc_processor is not None and self.rtc_processor.rtc_config.enabled

    @property
    def geometry_in_prefix(self) -> bool:
        """Whether geometry stands in the VLM's own prefix, and not in a segment of its own."""
        return self.config.geometry is not None and self.config.geometry.placement == "prefix"

    def gradient_checkpointing_enable(self) -> None:
        """Recompute each layer once in the backward pass (a layer then runs twice per training step)."""
        self.paligemma_with_expert.gradient_checkpointing = True

    def compile_training(self) -> None:
        """Compile the layers where they train (layer_calls.py); in evaluation mode they stay as they are."""
        self.paligemma_with_expert.compiled = True

    def embed_prefix(
        self, images: Sequence[Tensor | None], img_masks: Sequence[Tensor], tokens: Tensor, masks: Tensor
    ) -> SegmentTokens:
        """Vision and text.

        images: per camera (B, 3, H, W) in [-1, 1], or None for a camera that is absent, which is not encoded.
        img_masks: per camera (B,) bool. tokens: (B, L) ids. masks: (B, L) bool.
        Returns embeddings (B, P, W_vlm) with zeros in padded slots, their mask, and P zeros.
        """
        network = self.paligemma_with_expert
        text = network.embed_language_tokens(tokens.masked_fill(~masks, 0))
        embs, pads = [], []
        present = [(image, mask) for image, mask in zip(images, img_masks, strict=True) if image is not None]
        if present:
            # The values of a masked image must not reach a gradient either: 0 x NaN is NaN in the backward pass.
            shown = [image.masked_fill(~mask[:, None, None, None], 0.0) for image, mask in present]
            patches = network.embed_image(torch.cat(shown))  # (V * B, patches, W_vlm)
            embs = list(patches.chunk(len(present)))
            pads = [mask[:, None].expand(-1, patches.shape[1]) for _, mask in present]
        pad = torch.cat([*pads, masks], dim=1)
        embedded = torch.cat([*(e.to(text.dtype) for e in embs), text], dim=1)
        return SegmentTokens(_silence(embedded, pad), pad, [0] * pad.shape[1])

    def embed_time(self, timestep: Tensor) -> Tensor:
        """Flow time (...) -> adaRMS condition (..., W) float32: sine-cosine embedding and an MLP.

        The embedding is computed in float64 where the device has it.
        """
        width = self.action_in_proj.out_features
        dtype = get_safe_dtype(torch.float64, timestep.device.type)
        exponent = torch.linspace(0.0, 1.0, width // 2, dtype=dtype, device=timestep.device)
        period = self.config.min_period * (self.config.max_period / self.config.min_period) ** exponent
        angle = timestep[..., None].to(dtype) * (2 * math.pi / period)
        embedded = torch.cat([angle.sin(), angle.cos()], dim=-1).float()
        return F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(embedded))))

    def embed_suffix(self, noisy_actions: Tensor, timestep: Tensor) -> tuple[Tensor, Tensor, AttMasks, Tensor]:
        """Noisy actions (B, S, D) and flow time -> embeddings (B, S, W), mask (B, S), att_masks, adaRMS condition.

        timestep: (B,), or (B, K) for K groups of S / K steps, so one per step for K = S. The condition: (B, W) or (B, K, W).
        """
        embs = self.action_in_proj(noisy_actions)
        pad = torch.ones(embs.shape[:2], dtype=torch.bool, device=embs.device)
        return embs, pad, one_block(embs.shape[1]), self.embed_time(timestep)

    def forward(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        actions: Tensor,
        noise: Tensor,
        time: Tensor,
        geom_embs: Tensor | None = None,
        geom_pad: Tensor | None = None,
        geom_att: AttMasks | Tensor | None = None,
        delay: Tensor | None = None,
    ) -> Tensor:
        """Flow-matching loss of every action entry, unreduced, in the shape of `noise`, float32.

        actions: (B, S, D). noise: (B, S, D) and time: (B,), or (B, K, S, D) and (B, K): K flow samples of the same
        observation share one pass over prefix and geometry, blind to each other and all at the same positions.
        geom_embs: (B, G, W) tokens of the geometry adapter, geom_pad: (B, G) bool, False for a hole, geom_att: G
        entries, or a tensor (G,) or (B, G) with equal rows; one block by default. delay: (B,) int64, the first steps that are
        given clean, at flow time 0, as in trained RTC; their entries of the result are no loss. The rest as in `embed_prefix`.
        """
        samples = noise.shape[1] if noise.ndim == 4 else 1
        # Every flow time has a geometry of its own, so the samples cannot share it.
        if noise.ndim == 4 and self.geometry_follows_time:
            observation, others = (images, img_masks, tokens, masks), (geom_embs, geom_pad, geom_att, delay)
            flow = zip(noise.unbind(1), time.unbind(1), strict=True)
            return torch.stack([self.forward(*observation, actions, n, t, *others) for n, t in flow], dim=1)
        step_time = time if delay is None else _time_per_step(time, noise.shape[-2], delay)  # (B[, K][, S])
        t = step_time[..., None, None] if delay is None else step_time[..., None]
        clean = actions if noise.ndim == 3 else actions[:, None]
        with compute_in(self.config.dtype, tokens.device):
            prefix, geometry = self._context(images, img_masks, tokens, masks, geom_embs, geom_pad, geom_att)
            x_t = t * noise + (1 - t) * clean
            embs, pad, att, cond = self.embed_suffix(
                x_t.flatten(1, -2), step_time if step_time.ndim == 1 else step_time.flatten(1)
            )
            suffix, geometry_cond = SegmentTokens(embs, pad, att), self._geometry_cond(geometry, time)
            output, _ = self._run([prefix, geometry, suffix], cond, geometry_cond, samples=samples)
            velocity = self.action_out_proj(output).view_as(noise)
        return F.mse_loss(velocity, noise - clean, reduction="none")

    @torch.no_grad()
    def sample_actions(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        noise: Tensor | None = None,
        num_steps: int | None = None,
        geom_embs: Tensor | None = None,
        geom_pad: Tensor | None = None,
        geom_att: AttMasks | Tensor | None = None,
        use_cache: bool = True,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
    ) -> Tensor:
        """Integrate the flow from noise to an action chunk, (B, S, D) float32.

        noise: (B, S, D), drawn here if None. num_steps: Euler steps, the configured number if None.
        use_cache=False recomputes every segment at every step: the slow reference that caching must equal.
        The last three arguments are LeRobot's real-time chunking, see real_time_chunking.py. The rest as in `forward`.
        """
        config = self.config
        if noise is None:
            noise = torch.randn(tokens.shape[0], config.chunk_size, config.max_action_dim, device=tokens.device)
        with compute_in(config.dtype, tokens.device):
            prefix, geometry = self._context(images, img_masks, tokens, masks, geom_embs, geom_pad, geom_att)
            cache = self._prefill(prefix, geometry, noise.shape[1]) if use_cache else None
            hard = None
            if self.rtc_enabled and prev_chunk_left_over is not None:
                require_delay(inference_delay)
                if self.rtc_mode == "trained":
                    hard = make_hard_prefix(prev_chunk_left_over, inference_delay, config.rtc_training_max_delay, noise)
            actions: Tensor = euler_integrate(
                lambda x_t, timestep: self._velocity(prefix, geometry, cache, x_t, timestep, hard),
                noise,
                num_steps or config.num_inference_steps,
                rtc_processor=self.rtc_processor,
                rtc_enabled=self.rtc_enabled and self.rtc_mode == "guided",
                inference_delay=inference_delay,
                prev_chunk_left_over=prev_chunk_left_over,
                execution_horizon=execution_horizon,
            )
            return actions if hard is None else hard.impose(actions)

    def denoise_step(
        self,
        prefix_pad_masks: Tensor,
        past_key_values: SegmentKVCache,
        x_t: Tensor,
        timestep: Tensor,
        geometry: SegmentTokens | None = None,
    ) -> Tensor:
        """One step from a filled cache: velocity (B, S, D) float32 at x_t (B, S, D) and flow time (B,).

        prefix_pad_masks: (B, P) bool, as cached. geometry: the geometry segment that was cached, or None.
        """
        prefix = SegmentTokens(None, prefix_pad_masks, [0] * prefix_pad_masks.shape[1])
        return self._velocity(prefix, geometry, past_key_values, x_t, timestep)

    @torch.no_grad()
    def _velocity(
        self,
        prefix: SegmentTokens,
        geometry: SegmentTokens | None,
        cache: SegmentKVCache | None,
        x_t: Tensor,
        timestep: Tensor,
        hard: HardPrefix | None = None,
    ) -> Tensor:
        """Velocity of the flow, from the cache or, without one, from every segment anew.

        `no_grad` although LeRobot's RTC calls this under `enable_grad`: its guidance uses no gradient of the network,
        and in-place cache writes must not chain graphs.
        """
        with compute_in(self.config.dtype, x_t.device):
            step_time = timestep
            if hard is not None:
                x_t = hard.impose(x_t)
                step_time = timestep[:, None].masked_fill(hard.mask, 0.0)  # (B, S)
            embs, pad, att, cond = self.embed_suffix(x_t, step_time)
            given = [True, True, True] if cache is None else [False, self.geometry_follows_time, True]
            geometry_cond = self._geometry_cond(geometry if given[Segment.GEOMETRY] else None, timestep)
            output, _ = self._run([prefix, geometry, SegmentTokens(embs, pad, att)], cond, geometry_cond, cache, given)
            return self.action_out_proj(output)

    @property
    def geometry_follows_time(self) -> bool:
        """Whether geometry is conditioned on the flow time of the denoising step, and so computed anew at every step."""
        return self.config.geometry is not None and self.config.geometry.time == "denoise"

    def _context(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        geom_embs: Tensor | None,
        geom_pad: Tensor | None,
        geom_att: AttMasks | Tensor | None,
    ) -> tuple[SegmentTokens, SegmentTokens | None]:
        """The two segments that do not depend on the actions."""
        prefix = self.embed_prefix(images, img_masks, tokens, masks)
        if geom_embs is None:
            return prefix, None
        geometry = self.embed_geometry(geom_embs, geom_pad, geom_att)
        return (prefix.followed_by(geometry), None) if self.geometry_in_prefix else (prefix, geometry)

    def embed_geometry(
        self, geom_embs: Tensor, geom_pad: Tensor | None = None, geom_att: AttMasks | Tensor | None = None
    ) -> SegmentTokens:
        """Geometry tokens as a segment, with zeros in padded slots; arguments as in `forward`."""
        if self.config.geometry is None:
            raise ValueError(
                "This network was built without geometry (`geometry_source=none`); it cannot use geom_embs."
            )
        if geom_embs.shape[-1] != self.geometry_width:
            raise ValueError(f"geom_embs need width {self.geometry_width}, got {geom_embs.shape[-1]}.")
        pad = (
            torch.ones(geom_embs.shape[:2], dtype=torch.bool, device=geom_embs.device) if geom_pad is None else geom_pad
        )
        length = geom_embs.shape[1]
        att = one_block(length) if geom_att is None else att_masks_of(geom_att, length)
        return SegmentTokens(_silence(geom_embs, pad), pad, att)

    def _prefill(self, prefix: SegmentTokens, geometry: SegmentTokens | None, suffix_length: int) -> SegmentKVCache:
        """Run prefix and (clean) geometry once, and store their keys and values."""
        lengths = [prefix.pad.shape[1], 0 if geometry is None else geometry.pad.shape[1], suffix_length]
        cache = self.paligemma_with_expert.make_cache(prefix.pad.shape[0], lengths, prefix.pad.device)
        given = [True, not self.geometry_follows_time, False]
        self._run([prefix, geometry, None], None, self._geometry_cond(geometry, None), cache, given)
        return cache

    def _run(
        self,
        segments: Sequence[SegmentTokens | None],
        suffix_cond: Tensor | None,
        geometry_cond: Tensor | None,
        cache: SegmentKVCache | None = None,
        given: Sequence[bool] = (True, True, True),
        samples: int = 1,
    ) -> tuple[Tensor | None, SegmentKVCache | None]:
        """Run the given ones of these segments; the others are in the cache. Returns the suffix's output (B, S, W)."""
        pads = [None if s is None else s.pad for s in segments]
        atts = [None if s is None else s.att for s in segments]
        inputs = [s if keep else None for s, keep in zip(segments, given, strict=True)]
        geometry = self.config.geometry
        positions = segment_positions(pads, geometry.positions if geometry else "sequential", samples)
        outputs, cache = self.paligemma_with_expert(
            attention_mask=[
                None if inputs[s] is None else segment_mask(s, pads, atts, samples if s is Segment.SUFFIX else 1)
                for s in Segment
            ],
            position_ids=positions,
            past_key_values=cache,
            inputs_embeds=[None if s is None else s.embs for s in inputs],
            use_cache=cache is not None,
            adarms_cond=[None, geometry_cond, suffix_cond],
            outputs=(False, False, True),
        )
        return outputs[Segment.SUFFIX], cache

    def _geometry_cond(self, geometry: SegmentTokens | None, time: Tensor | None) -> Tensor | None:
        """The adaRMS condition of geometry, (1, W) at the clean end of the flow, time 0: geometry is a clean observation.

        Where geometry follows the flow time (B,) it is (B, W).
        """
        if geometry is None:
            return None
        if self.geometry_follows_time:
            return None if time is None else self.embed_time(time)
        return self.embed_time(torch.zeros(1, device=geometry.pad.device))


def _silence(embs: Tensor, pad: Tensor) -> Tensor:
    """Zero padded slots: a masked key has no effect, but a NaN in it would (NaN + -inf is NaN)."""
    return embs.masked_fill(~pad[..., None], 0)


def _time_per_step(time: Tensor, steps: int, delay: Tensor) -> Tensor:
    """Flow time (B,) or (B, K) of every action step, (B, S) or (B, K, S): 0 for the first `delay` (B,) steps of a sample."""
    clean = torch.arange(steps, device=time.device) < delay[:, None]  # (B, S)
    if time.ndim == 2:
        clean = clean[:, None]
    return time[..., None].masked_fill(clean, 0.0)
