"""The three segments of the sequence: their order, their tokens and their rotary positions.

```
            prefix                    geometry                     suffix
   image patches + prompt text   depth / point-map tokens     noisy actions (+ flow time)
   PaliGemma weights             action-expert weights        action-expert weights
  ├──────────── P ─────────────┤├────────── G ───────────┤├────────── S ──────────┤
```

Which segment attends to which is in segment_mask.py, the keys and values kept between denoising steps in
segment_cache.py, the gate on geometry in segment_gate.py, and the loop over the segments in paligemma_with_expert.py.

Shapes: B batch, N tokens, P|G|S tokens of the three segments, W width.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from .config import GeometryPositions


class Segment(IntEnum):
    """The three segments, in the order in which they stand in the sequence."""

    PREFIX = 0
    GEOMETRY = 1
    SUFFIX = 2


AttMasks = Sequence[int]


def att_masks_of(given: Sequence[int] | Tensor, length: int) -> list[int]:
    """A segment's `att_masks` as a list.

    given: `length` entries, or a tensor (length,) or (B, length) as other π0.5 code bases pass it.
    Raises ValueError for another length, and for a tensor whose rows differ: a segment has one mask for the whole batch.
    """
    if isinstance(given, Tensor):
        rows = given.reshape(1, -1) if given.ndim < 2 else given.flatten(0, -2)
        if (rows != rows[:1]).any():
            raise ValueError("geom_att must have equal rows: every sample of a batch has the same blocks.")
        given = rows[0].tolist()
    if len(given) != length:
        raise ValueError(f"geom_att needs one entry for each of the {length} geometry tokens, got {len(given)}.")
    return [int(entry) for entry in given]


def one_block(length: int) -> list[int]:
    """`att_masks` of a segment that opens a block of its own: 1 0 0 ... (empty for no tokens)."""
    return [1] + [0] * (length - 1) if length else []


class GeometryTokens(NamedTuple):
    """Geometry as the network takes it: tokens (B, G, W) and their validity (B, G) bool, False for a hole."""

    embs: Tensor
    pad: Tensor


class SegmentTokens(NamedTuple):
    """Tokens of one segment: padding mask (B, N) bool, openpi's att_masks (N entries), and embeddings (B, N, W).

    The embeddings are None where the segment's keys and values are read from the cache.
    """

    embs: Tensor | None
    pad: Tensor
    att: AttMasks

    def followed_by(self, other: "SegmentTokens") -> "SegmentTokens":
        """Both as one segment that is one block, in this one's dtype."""
        assert self.embs is not None
        assert other.embs is not None
        embs = torch.cat([self.embs, other.embs.to(self.embs.dtype)], dim=1)
        return SegmentTokens(embs, torch.cat([self.pad, other.pad], dim=1), [0] * embs.shape[1])


def segment_positions(pads: Sequence[Tensor | None], rule: GeometryPositions, samples: int = 1) -> list[Tensor | None]:
    """Rotary positions of each segment.

    sequential: cumsum over P|G|S - 1, so geometry moves the suffix, and so does a hole in it.
    parallel: the suffix counts P|S, as if geometry were not there; cell i stands at the first position after the
        prefix plus i, whether or not the cells before it are holes.

    pads: per segment (B, N_i) bool or None. samples: flow samples in the suffix, which all stand at the same positions.
    Returns per segment (B, N_i) int64 or None.
    """
    prefix, geometry, suffix = pads
    after: Tensor | int = 0  # position of the next real token, (B, 1)
    positions: list[Tensor | None] = [None, None, None]
    if prefix is not None:
        positions[Segment.PREFIX] = prefix.cumsum(dim=1) - 1
        after = prefix.sum(dim=1, keepdim=True)
    if geometry is not None:
        if rule == "parallel":
            positions[Segment.GEOMETRY] = after + torch.arange(geometry.shape[1], device=geometry.device).expand_as(
                geometry
            )
        else:
            positions[Segment.GEOMETRY] = after + geometry.cumsum(dim=1) - 1
            after = after + geometry.sum(dim=1, keepdim=True)
    if suffix is not None:
        positions[Segment.SUFFIX] = after + (suffix.unflatten(1, (samples, -1)).cumsum(dim=2) - 1).flatten(1)
    return positions
