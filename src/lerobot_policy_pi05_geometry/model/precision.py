"""The dtype policy, in one place.

`param_dtype` is how weights are stored, `dtype` what matrix products compute in. Two kinds of module stay in float32
whatever these say, because bfloat16 has too few digits (8 bits of mantissa) for them:

* `Float32Linear` and the geometry gate: they are trained with small updates, and an update below 1/256 of a weight
  vanishes in a bf16 weight. These are the geometry adapter, the gate, the action projections (their output is
  integrated over ten flow steps) and the flow-time MLP (its input has periods down to 0.004).
* Norms: mean and scale are taken in float32 and their weights stored in float32 (a scale of 1 + w loses w below 1/256),
  SigLIP's LayerNorms and the linear map of the adaptive norm included, since the flow time acts through it alone.

bf16 compute over float32 storage is autocast; a float32 module switches autocast off around itself, since a float32
Linear under autocast returns bf16.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


class Float32Module(nn.Module):
    """Marker: parameters of this module are stored in float32 whatever `param_dtype` says."""


@contextmanager
def compute_in(dtype: torch.dtype, device: torch.device) -> Iterator[None]:
    """Compute matrix products in `dtype`, whatever autocast the caller had switched on."""
    with torch.autocast(device.type, dtype=dtype, enabled=dtype != torch.float32):
        yield


@contextmanager
def compute_in_float32(device: torch.device) -> Iterator[None]:
    """Switch autocast off; the caller casts its inputs to float32."""
    with torch.autocast(device.type, enabled=False):
        yield


class Float32Linear(Float32Module, nn.Linear):
    """Linear layer that is stored and computed in float32: (..., in) any dtype -> (..., out) float32."""

    def forward(self, x: Tensor) -> Tensor:
        with compute_in_float32(x.device):
            return F.linear(x.float(), self.weight, self.bias)


def store_in(module: nn.Module, dtype: torch.dtype) -> None:
    """Cast the parameters of `module` to their storage dtype, leaving float32 modules and all in them as they are."""
    keep = isinstance(module, Float32Module | nn.LayerNorm)
    for parameter in module.parameters(recurse=keep):
        parameter.data = parameter.data.to(torch.float32 if keep else dtype)
    if not keep:
        for child in module.children():
            store_in(child, dtype)
