"""The three segments, layer by layer.

```
   layer l    prefix ──────────► geometry ─────────► suffix ───────►   hidden states of layer l + 1
                 │  keys, values ▲  │  keys, values   ▲
                 └───────────────┘──┴─────────────────┘                earlier segments only, so nothing flows back
```

Training gives all segments and concatenates keys and values; prefill writes prefix and geometry into the cache; a
denoising step gives only the suffix and reads the rest from the cache. All three are the loop below.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from transformers import SiglipVisionModel

from .attention import rotary_table
from .config import NetworkConfig
from .gemma import GemmaModel, KeysValues
from .layer_calls import call_layer
from .precision import store_in
from .segment_cache import SegmentKVCache
from .segment_gate import GeometryGate
from .segments import Segment
from .vision import Projector, build_vision_tower, embed_images


class PaliGemmaModel(nn.Module):
    """Vision tower, projector and language model, under LeRobot's names."""

    language_model: GemmaModel
    vision_tower: SiglipVisionModel
    multi_modal_projector: Projector

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        variant = config.paligemma
        self.vision_tower = build_vision_tower(variant, config.image_size)
        self.multi_modal_projector = Projector(variant.vision.width, variant.gemma.width)
        self.language_model = GemmaModel(variant.gemma, vocab_size=variant.vocab_size)


class Holder[T: nn.Module](nn.Module):
    """Names its content `model`, as in the released checkpoints."""

    model: T

    def __init__(self, model: T) -> None:
        super().__init__()
        self.model = model


class PaliGemmaWithExpert(nn.Module):
    """PaliGemma for the prefix, action-expert weights for geometry and suffix, one attention for all.

    Parameter names are LeRobot's; `geometry_gate` and, with `expert="own"`, `geometry_expert` are new.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.dtype = config.dtype
        self.gradient_checkpointing = False  # these two are for training mode
        self.compiled = False
        self.paligemma = Holder(PaliGemmaModel(config))
        self.gemma_expert = Holder(GemmaModel(config.expert, cond_dim=config.expert.width))
        self.language_model.freeze_unread_output()

        self.geometry_gate: GeometryGate | None = None
        self.geometry_expert: GemmaModel | None = None
        geometry = config.geometry
        if geometry is not None and geometry.placement == "segment":
            self.geometry_gate = GeometryGate(config.expert.depth, config.expert.num_heads, geometry.openness)
            if geometry.expert == "own":
                self.geometry_expert = GemmaModel(config.expert, cond_dim=config.expert.width)
                self.geometry_expert.load_state_dict(self.expert.state_dict())
                self.geometry_expert.freeze_unread_output()
        store_in(self, config.param_dtype)

    @property
    def language_model(self) -> GemmaModel:
        """The VLM's transformer."""
        return self.paligemma.model.language_model

    @property
    def expert(self) -> GemmaModel:
        """The action expert's transformer."""
        return self.gemma_expert.model

    def segment_model(self, segment: Segment) -> GemmaModel:
        """The transformer whose weights a segment runs through."""
        if segment is Segment.PREFIX:
            return self.language_model
        if segment is Segment.GEOMETRY and self.geometry_expert is not None:
            return self.geometry_expert
        return self.expert

    def set_trainable(self, train_expert_only: bool = False, freeze_vision_encoder: bool = False) -> None:
        """Freeze the whole VLM, or its vision tower (LeRobot's two settings)."""
        if train_expert_only:
            self.paligemma.requires_grad_(False)
        elif freeze_vision_encoder:
            self.paligemma.model.vision_tower.requires_grad_(False)

    def embed_image(self, images: Tensor) -> Tensor:
        """Images (N, 3, H, W) in [-1, 1] -> (N, patches, W_vlm), in one batch."""
        model = self.paligemma.model
        return embed_images(model.vision_tower, model.multi_modal_projector, images, self._call_layer)

    def _call_layer(self, layer: nn.Module, *arguments: Any) -> Any:
        training = self.training
        checkpointing, compiled = training and self.gradient_checkpointing, training and self.compiled
        return call_layer(layer, *arguments, checkpointing=checkpointing, compiled=compiled)

    def embed_language_tokens(self, tokens: Tensor) -> Tensor:
        """Token ids (B, L) -> (B, L, W_vlm)."""
        return self.language_model.embed(tokens)

    def make_cache(self, batch: int, lengths: Sequence[int], device: torch.device) -> SegmentKVCache:
        """An empty cache for segments of these lengths, in the compute dtype."""
        expert = self.config.expert
        return SegmentKVCache(expert.depth, batch, expert.num_kv_heads, expert.head_dim, lengths, self.dtype, device)

    def forward(
        self,
        attention_mask: Sequence[Tensor | None],
        position_ids: Sequence[Tensor | None],
        past_key_values: SegmentKVCache | None = None,
        inputs_embeds: Sequence[Tensor | None] = (None, None, None),
        use_cache: bool = False,
        adarms_cond: Sequence[Tensor | None] = (None, None, None),
        outputs: Sequence[bool] = (True, True, True),
    ) -> tuple[list[Tensor | None], SegmentKVCache | None]:
        """Run the given segments through all layers.

        Every sequence has one entry per segment, [prefix, geometry, suffix]; a list of two is [prefix, suffix], plain
        π0.5. An entry of `inputs_embeds` that is None is a segment whose keys and values are already in the cache, or
        that is absent.

        attention_mask: (B, 1 or Q_i, K_i) bool per given segment (`segment_mask.segment_mask`).
        position_ids: (B, N_i) per given segment (`segments.segment_positions`).
        past_key_values: cache to write to and read from; needs `use_cache=True`.
        inputs_embeds: (B, N_i, W_i) per segment.
        adarms_cond: embedded flow time (B or 1, W_expert) float32 for geometry and suffix.
        outputs: False skips the rest of a segment's last layer once its keys and values are there.

        Returns the final normed hidden states per segment, each (B, N_i, W_i) in the compute dtype or None, and the
        cache.
        """
        if use_cache != (past_key_values is not None):
            raise ValueError("`use_cache=True` needs `past_key_values`, a cache from `make_cache`, and only then.")
        embeds, masks, positions, conds, wanted = (
            _three(entries) for entries in (inputs_embeds, attention_mask, position_ids, adarms_cond, outputs)
        )
        given = [s for s in Segment if embeds[s] is not None]
        hidden: list[Tensor | None] = [None if x is None else x.to(self.dtype) for x in embeds]
        rotary = {s: rotary_table(positions[s], self.config.expert.head_dim) for s in given}
        depth = self.config.expert.depth

        for index in range(depth):
            earlier: KeysValues | None = None
            for segment in given:
                layer = self.segment_model(segment).layers[index]
                slot = None if past_key_values is None else past_key_values.slot(index, segment)
                hidden[segment], earlier = self._call_layer(
                    layer,
                    hidden[segment],
                    rotary[segment],
                    masks[segment],
                    conds[segment],
                    self._gate_bias(index, segment, embeds, past_key_values),
                    earlier,
                    slot,
                    bool(wanted[segment]) or index < depth - 1,
                )

        results: list[Tensor | None] = [None, None, None]
        for segment in given:
            if wanted[segment]:
                results[segment], _ = self.segment_model(segment).norm(hidden[segment], conds[segment])
        return results, past_key_values

    def _gate_bias(
        self, layer: int, segment: Segment, embeds: Sequence[Tensor | None], cache: SegmentKVCache | None
    ) -> Tensor | None:
        """The gate as an attention bias (H, K), on the suffix's queries only; None where no geometry is seen."""
        if self.geometry_gate is None or segment is not Segment.SUFFIX:
            return None
        lengths = cache.lengths if cache else [0 if x is None else x.shape[1] for x in embeds]
        if not lengths[Segment.GEOMETRY]:
            return None
        return self.geometry_gate(layer, *lengths)


def _three(entries: Sequence) -> list:
    """[prefix, suffix] -> [prefix, None, suffix]."""
    return [entries[0], None, entries[1]] if len(entries) == 2 else list(entries)
