"""Weights of one segment's layers in the form that the runner wants: fewer and larger matrices, in the compute dtype.

```
   q_proj | k_proj | v_proj  ─►  one matrix          gate_proj | up_proj  ─►  one matrix
```

Where a weight is stored in the compute dtype already, the network's own parameters become views of the large matrix: nothing
is held twice, and what changes the one in place changes the other. Otherwise (bf16 compute over float32 storage) the large
matrices are copies; `Weights.stale` tells when the network has moved on.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_post_hook

from ..model.gemma import GemmaLayer, GemmaModel, RMSNorm

_DONE: Counter[str] = Counter()  # "steps" of any optimiser of this process


def _count_step(*_: Any) -> None:
    _DONE["steps"] += 1


# torch's fused optimisers leave the versions of what they write as they were
register_optimizer_step_post_hook(_count_step)


class NotPlainError(TypeError):
    """A projection cannot be joined with others."""


@dataclass(frozen=True)
class FusedLayer:
    """One layer's matrices, (out, in) in the compute dtype, and the weights of its plain norms, (W,) float32 or None."""

    qkv: Tensor
    out: Tensor
    gate_up: Tensor
    down: Tensor
    norm: Tensor | None
    post_norm: Tensor | None


def fuse(model: GemmaModel, dtype: torch.dtype) -> list[FusedLayer]:
    """All layers of a segment's transformer. Raises NotPlainError for a projection that is not a plain linear layer."""
    return [_fuse_layer(layer, dtype) for layer in model.layers]


def _fuse_layer(layer: nn.Module, dtype: torch.dtype) -> FusedLayer:
    assert isinstance(layer, GemmaLayer)
    attention, mlp = layer.self_attn, layer.mlp
    return FusedLayer(
        qkv=_join([attention.q_proj, attention.k_proj, attention.v_proj], dtype),
        out=_join([attention.o_proj], dtype),
        gate_up=_join([mlp.gate_proj, mlp.up_proj], dtype),
        down=_join([mlp.down_proj], dtype),
        norm=_norm_weight(layer.input_layernorm),
        post_norm=_norm_weight(layer.post_attention_layernorm),
    )


def copied(model: GemmaModel, dtype: torch.dtype) -> list[Tensor]:
    """The weights of which the runner has copies: those of another dtype."""
    weights = (module.weight.detach() for module in model.layers.modules() if type(module) is nn.Linear)
    return [weight for weight in weights if weight.dtype != dtype]


def _norm_weight(norm: nn.Module) -> Tensor | None:
    """Of a plain norm, in its own storage; None for an adaptive one, whose scale follows the flow time."""
    return norm.weight.detach() if isinstance(norm, RMSNorm) else None


def _join(linears: list[nn.Linear], dtype: torch.dtype) -> Tensor:
    for linear in linears:
        if type(linear) is not nn.Linear or linear.bias is not None:
            raise NotPlainError(f"a projection is a {type(linear).__name__}, not a plain linear layer")
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
    """The large matrix that these weights are the rows of, if they stand one after the other in one storage."""
    storage, place = weights[0].untyped_storage(), weights[0].storage_offset()
    for weight in weights:
        same = weight.untyped_storage()._cdata == storage._cdata
        if not same or weight.storage_offset() != place or not weight.is_contiguous():
            return None
        place += weight.numel()
    first, rows = weights[0].detach(), sum(weight.shape[0] for weight in weights)
    return first.as_strided((rows, first.shape[1]), (first.shape[1], 1))


class Weights:
    """Remembers a network's modules, parameters and where they lie, and what those hold from which something was computed.

    read: these last. A write through `parameter.data` leaves no version behind, so vectors and the diagonals of matrices are
    compared, too: they show whatever changes a weight as a whole (an average of weights, say), not every single entry.
    """

    def __init__(self, network: nn.Module, read: Sequence[Tensor] = ()) -> None:
        # Held, or a module that comes later could have the address of one that went.
        self._modules = list(network.modules())
        self._members = [
            entries for module in self._modules for entries in (module._modules, module._parameters) if entries
        ]
        self._parameters = list(network.parameters())
        self._read = list(read)
        self._seen = self._look()
        if self._read:
            self._values = self._sample()

    def _look(self) -> tuple[int, ...]:
        members = (id(member) for entries in self._members for member in entries.values())
        places = tuple((p.untyped_storage()._cdata, p.storage_offset()) for p in self._parameters)
        writes = (sum(weight._version for weight in self._read), _DONE["steps"]) if self._read else ()
        return (hash(tuple(members)), hash(places), *writes)

    def _sample(self) -> Tensor:
        """Some of the values, as bits (a NaN does not equal itself)."""
        return torch.cat([weight.diagonal() if weight.ndim == 2 else weight for weight in self._read]).view(torch.uint8)

    def stale(self) -> bool:
        """Whether the network is another than it was. On a GPU this waits for it if there is anything to compare."""
        return self._look() != self._seen or (bool(self._read) and not torch.equal(self._values, self._sample()))
