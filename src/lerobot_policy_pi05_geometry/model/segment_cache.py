"""Keys and values of one observation, kept across denoising steps.

```
   one buffer per layer   (B, kv_heads, P + G + S, head_dim)
   ├──────── P ────────┤├────── G ──────┤├────── S ──────┤
    written once         written once     overwritten in place
    per observation      per observation  at every step
```

Nothing is cloned, concatenated or grown; reading "up to a segment" is a view. Inference only: in-place writes would
break autograd, so training concatenates instead (see `gemma.py`).
"""

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from .segments import Segment


class SegmentKVCache:
    """Preallocated keys and values of `num_layers` layers for the three segments.

    lengths: tokens of prefix, geometry and suffix; 0 for an absent segment.
    """

    def __init__(
        self,
        num_layers: int,
        batch: int,
        num_kv_heads: int,
        head_dim: int,
        lengths: Sequence[int],
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.lengths = tuple(lengths)
        ends = list(accumulate(self.lengths))
        self._spans = [slice(end - length, end) for end, length in zip(ends, self.lengths, strict=True)]
        shape = (num_layers, batch, num_kv_heads, ends[-1], head_dim)
        self.keys = torch.zeros(shape, dtype=dtype, device=device)
        self.values = torch.zeros(shape, dtype=dtype, device=device)

    def slot(self, layer: int, segment: Segment) -> "CacheSlot":
        """The slot of one segment in one layer."""
        span = self._spans[segment]
        return CacheSlot(
            self.keys[layer, :, :, span],
            self.values[layer, :, :, span],
            self.keys[layer, :, :, : span.stop],
            self.values[layer, :, :, : span.stop],
        )

    def span(self, segment: Segment) -> slice:
        """Columns of a segment in the buffers."""
        return self._spans[segment]


class CacheSlot:
    """The part of the cache that one segment of one layer writes, and the part that it then sees."""

    def __init__(self, keys: Tensor, values: Tensor, seen_keys: Tensor, seen_values: Tensor) -> None:
        self._keys, self._values = keys, values
        self._seen = seen_keys, seen_values

    @torch.no_grad()
    def write(self, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Store (B, kv_heads, N, head_dim) in place; return views of all keys and values up to this segment's end."""
        self._keys.copy_(keys)
        self._values.copy_(values)
        return self._seen
