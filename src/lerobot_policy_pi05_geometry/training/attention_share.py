"""How much of the actions' attention lies on geometry, measured while a batch is trained on."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from ..model.attention import attention_weights
from ..model.paligemma_with_expert import PaliGemmaWithExpert


class AttentionShare:
    """Sums up, over the forward passes inside `measuring`, the softmax weight that action tokens give to geometry.

    Three layers stand for all: each one's softmax is computed a second time, without a gradient. geometry: tokens of the segment.
    """

    def __init__(self, network: PaliGemmaWithExpert, geometry: int) -> None:
        layers = network.expert.layers
        self._attentions = [layers[i].self_attn.attention for i in sorted({0, len(layers) // 2, len(layers) - 1})]
        self._geometry = geometry
        self._shares: list[Tensor] = []
        self._samples: list[Tensor] = []

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Look at what attention is given, by hooks that are gone afterwards."""
        handles = [attention.register_forward_pre_hook(self._look) for attention in self._attentions]
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    @torch.no_grad()
    def _look(self, _: nn.Module, inputs: tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]) -> None:
        q, k, _values, mask, bias = inputs
        if bias is None:  # only actions that see geometry have one
            return
        end = k.shape[2] - q.shape[2]  # keys are prefix, geometry, suffix
        columns = slice(end - self._geometry, end)
        share = attention_weights(q, k, mask, bias)[..., columns].float().sum(dim=-1).mean(dim=(1, 2))  # (B,)
        has_geometry = mask[..., columns].flatten(1).any(dim=1)
        self._shares.append((share * has_geometry).sum())
        self._samples.append(has_geometry.sum())

    def mean(self) -> Tensor | None:
        """Share in [0, 1], the mean over layers, heads, actions and the samples that have geometry; None if nothing was seen."""
        if not self._samples:
            return None
        return torch.stack(self._shares).sum() / torch.stack(self._samples).sum().clamp_min(1)
