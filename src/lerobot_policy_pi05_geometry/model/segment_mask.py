"""The attention mask: which segment attends to which.

```
   queries, keys  prefix     geometry   suffix
   prefix           x         .          .       the pretrained VLM never sees geometry
   geometry         x         x          .       geometry reads the scene and the instruction
   suffix           x         x          x       actions read everything
```

openpi's convention for `att_masks`: token j is visible to token i when the cumulative sum of the entries up to j is not
above that up to i. A 1 opens a block that earlier tokens cannot see, a 0 joins the block before. Geometry and suffix
must each open a block of their own:

```
   prefix 0 0 0 0 | geometry 1 0 0 | suffix 1 0 0        cumulative sum  0 0 0 0 | 1 1 1 | 2 2 2
   prefix 0 0 0 0 | geometry 0 0 0 | ...                 wrong: geometry joins the prefix, and the VLM sees it
```

So a segment sees whole earlier segments and itself, and its attention mask is a rectangle: its own rows, the columns
up to its end. When a segment is one block (always, unless `geom_att` says otherwise) the rectangle depends on the key
alone and is kept as one row, (B, 1, K). Keys are masked, never queries: a query row with every key masked turns into
NaN inside softmax, and NaN x 0 spreads.

Shapes: B batch, N tokens, Q query tokens, K key tokens.
"""

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from .segments import AttMasks, Segment


def make_att_mask(pad_masks: Tensor, att_masks: AttMasks) -> Tensor:
    """Square attention mask of a whole sequence, the reference for the rectangles.

    pad_masks: (B, N) bool, True for real tokens. att_masks: N entries, see the module's docstring.
    Returns (B, N, N) bool, [b, query, key]. Source: openpi `make_attn_mask`, but masking keys only.
    """
    block = torch.tensor(list(accumulate(att_masks)), device=pad_masks.device)  # (N,)
    visible = block[None, :] <= block[:, None]  # (N, N)
    return visible[None] & pad_masks[:, None, :]


def segment_mask(
    segment: Segment, pads: Sequence[Tensor | None], atts: Sequence[AttMasks | None], samples: int = 1
) -> Tensor:
    """Attention mask of one segment's queries against the keys of all segments up to its own.

    pads, atts: per segment, (B, N_i) bool and N_i entries; None for an absent segment.
    samples: flow samples that stand side by side in the segment and do not attend to each other (the suffix in training).
    Returns (B, 1, K) bool where every query of the segment sees the same keys, else (B, Q, K).
    """
    present = [s for s in Segment if s <= segment and pads[s] is not None]
    seen = [pad for pad in pads[: segment + 1] if pad is not None]
    keys = torch.cat(seen, dim=1)  # (B, K)
    lengths = [pad.shape[1] for pad in seen]
    flat = [int(entry) for s in present for entry in (atts[s] or [])]
    if len(flat) != sum(lengths):
        raise ValueError(f"att_masks need one entry per token: {sum(lengths)} tokens, {len(flat)} entries.")
    blocks = list(accumulate(flat))
    start = sum(lengths[:-1])
    if start and lengths[-1] and blocks[start] == blocks[start - 1]:
        raise ValueError(
            f"The first token of the {segment.name.lower()} segment must have att_mask 1: with 0 it joins the "
            "block before it, which then sees it too."
        )
    own = blocks[start:]
    if own and own[0] != own[-1]:
        return make_att_mask(keys, flat)[:, start:]
    if samples == 1:
        return keys[:, None, :]
    sample = torch.arange(lengths[-1], device=keys.device) // (lengths[-1] // samples)  # (N,)
    earlier = torch.ones(lengths[-1], start, dtype=torch.bool, device=keys.device)
    return keys[:, None, :] & torch.cat([earlier, sample[:, None] == sample[None]], dim=1)
