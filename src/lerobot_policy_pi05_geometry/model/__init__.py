"""The network: tensors in, tensors out. It knows nothing of datasets, robots, files or the hub.

```
            prefix                    geometry                     suffix
   image patches + prompt text   depth / point-map tokens     noisy actions (+ flow time)
   PaliGemma weights             action-expert weights        action-expert weights
  ├──────────── P ─────────────┤├────────── G ───────────┤├────────── S ──────────┤

   segments             the three segments: order, tokens, positions       gemma     one transformer layer of one segment
   segment_mask         which segment attends to which                     attention one function for every query
   segment_cache        keys and values kept between denoising steps       vision    SigLIP, all cameras in one batch
   segment_gate         a learned weight of geometry in the actions' attention
   paligemma_with_expert    the loop over segments, layer by layer         pi05      embed, train, sample
   flow_matching        noise and flow times that a resumed run draws again
   config, variants     what the network has to be told; named sizes       precision what stays in float32, and why
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
