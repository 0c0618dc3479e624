"""The weights of a segment's layers as the runner reads them: fewer and larger matrices, in the compute dtype.

```
   q_proj | k_proj | v_proj  ─►  one matrix          gate_proj | up_proj  ─►  one matrix
```

Where a weight is stored in the compute dtype, the network's own parameters become views of the large matrix. Nothing is held
twice, and a write to one is a write to the other. Otherwise (bf16 compute, float32 storage) the large matrices are copies.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..model.gemma import GemmaLayer, GemmaModel
from ..model.norms import RMSNorm

# The parameters of a layer. The runner computes with these and no others.
_PROJECTIONS = {
    "self_attn.q_proj",
    "self_attn.k_proj",
    "self_attn.v_proj",
    "self_attn.o_proj",
    "mlp.gate_proj",
    "mlp.up_proj",
    "mlp.down_proj",
}
_NORMS = {"input_layernorm", "post_attention_layernorm"}


class UnsupportedLayerError(TypeError):
    """A layer has a module that the runner cannot compute with, such as an unmerged LoRA."""


@dataclass(frozen=True)
class FusedLayer:
    """One layer's matrices, (out, in) in the compute dtype, and the weights of its plain norms, (W,) float32.

    The weights of adaptive norms are None: their scale follows the flow time.
    """

    qkv: Tensor
    out: Tensor
    gate_up: Tensor
    down: Tensor
    norm: Tensor | None
    post_norm: Tensor | None


def fuse(model: GemmaModel, dtype: torch.dtype) -> list[FusedLayer]:
    """All layers of a segment's transformer. Raises UnsupportedLayerError for a layer with other modules than Gemma's."""
    return [_fuse_layer(layer, dtype) for layer in model.layers]


def _fuse_layer(layer: nn.Module, dtype: torch.dtype) -> FusedLayer:
    assert isinstance(layer, GemmaLayer)
    _require_known_modules(layer)
    attention, mlp = layer.self_attn, layer.mlp
    return FusedLayer(
        qkv=_join([attention.q_proj, attention.k_proj, attention.v_proj], dtype),
        out=_join([attention.o_proj], dtype),
        gate_up=_join([mlp.gate_proj, mlp.up_proj], dtype),
        down=_join([mlp.down_proj], dtype),
        norm=_norm_weight(layer.input_layernorm),
        post_norm=_norm_weight(layer.post_attention_layernorm),
    )


def _require_known_modules(layer: GemmaLayer) -> None:
    for name, module in layer.named_modules():
        if name in _PROJECTIONS and (type(module) is not nn.Linear or module.bias is not None):
            raise UnsupportedLayerError(f"a projection is a {type(module).__name__}, not a plain linear layer")
    for name, _ in layer.named_parameters():
        owner = name.rpartition(".")[0]
        if owner not in _PROJECTIONS and owner.removesuffix(".dense") not in _NORMS:
            raise UnsupportedLayerError(f"a layer has the parameter {name}, which the runner does not know")


def _norm_weight(norm: nn.Module) -> Tensor | None:
    """The weight of a plain norm, in its own storage; None for an adaptive norm."""
    return norm.weight.detach() if isinstance(norm, RMSNorm) else None


def _join(linears: list[nn.Linear], dtype: torch.dtype) -> Tensor:
    weights = [linear.weight for linear in linears]
    if weights[0].dtype != dtype:
        return torch.cat([weight.detach().to(dtype) for weight in weights])
    if len(weights) == 1:
        return weights[0].detach()
    whole = _already_joined(weights)
    if whole is None:
        whole = torch.cat([weight.detach() for weight in weights])
        start = 0
        for weight in weights:  # one at a time, so that no more than one matrix is held twice
            weight.data = whole[start : start + weight.shape[0]]
            start += weight.shape[0]
    return whole


def _already_joined(weights: list[Tensor]) -> Tensor | None:
    """The large matrix whose rows these weights are, if they stand one after the other in one storage."""
    storage, offset = weights[0].untyped_storage(), weights[0].storage_offset()
    for weight in weights:
        same = weight.untyped_storage()._cdata == storage._cdata
        if not same or weight.storage_offset() != offset or not weight.is_contiguous():
            return None
        offset += weight.numel()
    first, rows = weights[0].detach(), sum(weight.shape[0] for weight in weights)
    return first.as_strided((rows, first.shape[1]), (first.shape[1], 1))
