"""The network: tensors in, tensors out. It knows nothing of datasets, robots, files or the hub.

```
            prefix                    geometry                     suffix
   image patches + prompt text   depth / point-map tokens     noisy actions (+ flow time)
   PaliGemma weights             action-expert weights        action-expert weights
  ├──────────── P ─────────────┤├────────── G ───────────┤├────────── S ──────────┤

   variants    named sizes                        attention   one function for every query in the network
   config      what the network has to be told    gemma       one transformer layer of one segment
   layout      who sees whom, and at which place  vision      SigLIP, all cameras in one batch
   cache       keys and values of an observation  paligemma_with_expert    the three segments, layer by layer
   precision   what stays in float32, and why     pi05        embed, train, sample
   gate        how open the door to geometry is   flow        noise that a resumed run draws again
   runner      a whole chunk, fast: the network's arithmetic without its modules (fused: its matrices; fast_layers: its layers)
   graphs      the runner's chunks as CUDA graphs                 side_stream    geometry measured beside vision and prefix
   sampler     the runner, or the plain path where the runner does not apply
```
"""

from .cache import SegmentKVCache
from .config import GeometrySegmentConfig, NetworkConfig
from .layout import Segment
from .paligemma_with_expert import PaliGemmaWithExpert
from .pi05 import PI05Pytorch

__all__ = [
    "GeometrySegmentConfig",
    "NetworkConfig",
    "PI05Pytorch",
    "PaliGemmaWithExpert",
    "Segment",
    "SegmentKVCache",
]
