"""Matrices in the order in which oneDNN reads them, for products with few tokens on a CPU in bfloat16.

```
   a matrix as it lies    every product puts it in order first: for the 50 tokens of a chunk, a third of the work
   packed                 put in order once; ten denoising steps read it (a copy: see `Weights` in fused_weights.py)
```

The numbers are the same. The operations are PyTorch's own, which its compiler uses for weights that it freezes
(torch/_inductor/fx_passes/mkldnn_fusion.py), but they have no public name: a PyTorch or a CPU without them packs nothing.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor


def why_not_packed(kernels: str, dtype: torch.dtype) -> str | None:
    """Why matrices are better read as they lie on this type of device, as the rest of a sentence; None if they are not."""
    if kernels != "cpu" or dtype != torch.bfloat16:
        return "only a CPU in bfloat16 gains by it"
    operations = ("_reorder_linear_weight", "_linear_pointwise", "_is_mkldnn_bf16_supported")
    if not torch.backends.mkldnn.is_available() or not all(hasattr(torch.ops.mkldnn, name) for name in operations):
        return "this PyTorch lacks the operations"
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return "this CPU has no products in bfloat16"
    return None


def pack(matrix: Tensor, tokens: int) -> Tensor:
    """A copy of a matrix (out, in) in oneDNN's order, for products with about as many tokens."""
    return torch.ops.mkldnn._reorder_linear_weight(matrix, tokens)


def linear(x: Tensor, matrix: Tensor, first: int = 0) -> Tensor:
    """x (B, N, in) times the rows from `first` on of a matrix (out, in), packed or not: (B, N, out - first)."""
    if matrix.is_mkldnn:  # what is packed has no rows: all are computed
        return torch.ops.mkldnn._linear_pointwise(x, matrix, None, "none", [], "")[..., first:]
    return F.linear(x, matrix[first:] if first else matrix)
