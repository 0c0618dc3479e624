"""The network: tensors in, tensors out. It does not depend on datasets, robots, files or the hub.

```
            prefix                    geometry                     suffix
   image patches + prompt text   depth / point-map tokens     noisy actions (+ flow time)
   PaliGemma weights             action-expert weights        action-expert weights
  ├──────────── P ─────────────┤├────────── G ───────────┤├────────── S ──────────┤

   segments             the three segments: order, tokens, positions       gemma     one transformer layer of one segment
   segment_mask         which segment attends to which                     attention the softmax, and rotary positions
   segment_cache        keys and values kept between denoising steps       vision    SigLIP, all cameras in one batch
   segment_gate         a learned weight of geometry in the actions' attention
   paligemma_with_expert    the loop over segments, layer by layer         pi05      embed, train, sample
   flow_matching        noise and flow times, keyed for resumed runs       norms     plain and adaptive, and the residual
   real_time_chunking   inputs of guided and trained RTC                   precision storage and compute dtypes
   config, variants     settings of the network; named sizes               ablations options that only experiments change
```
"""

from .config import GeometrySegmentConfig, NetworkConfig
from .paligemma_with_expert import PaliGemmaWithExpert
from .pi05 import PI05Pytorch
from .segment_cache import SegmentKVCache
from .segments import Segment

__all__ = [
    "GeometrySegmentConfig",
    "NetworkConfig",
    "PI05Pytorch",
    "PaliGemmaWithExpert",
    "Segment",
    "SegmentKVCache",
]
