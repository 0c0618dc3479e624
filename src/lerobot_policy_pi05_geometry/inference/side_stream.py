"""Geometry that is measured while the GPU computes the prefix, on a stream of its own.

```
   main stream    ──► vision ─► prefix ──────────┬─► geometry segment ─► denoising
   side stream    ──► Depth Anything 3, adapter ─┘
```
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..model.segments import GeometryTokens


class PendingGeometry(NamedTuple):
    """Geometry that has not been measured yet. measure: called once. num_tokens: G, known before."""

    num_tokens: int
    measure: Callable[[], GeometryTokens]

    @classmethod
    def given(cls, embs: Tensor, pad: Tensor | None) -> "PendingGeometry":
        """Geometry that has been measured; without `pad` every token counts."""
        if pad is None:
            pad = torch.ones(embs.shape[:2], dtype=torch.bool, device=embs.device)
        return cls(embs.shape[1], lambda: GeometryTokens(embs, pad))


class SideStream:
    """Runs work beside the main stream's. On a CPU, which has no streams, it runs it at once."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def begin_here(self) -> None:
        """Later work on the side waits for all work that the main stream was given before this call."""
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(self._device))

    def run[T](self, work: Callable[[], T]) -> T:
        """The result of `work`, launched on the side; the main stream waits for it, the host does not.

        The memory of `work` needs no bookkeeping: only later work on the side reuses it, and that waits for the main stream
        by `begin_here`.
        """
        if self._stream is None:
            return work()
        with torch.cuda.stream(self._stream):
            result = work()
        torch.cuda.current_stream(self._device).wait_stream(self._stream)
        return result
