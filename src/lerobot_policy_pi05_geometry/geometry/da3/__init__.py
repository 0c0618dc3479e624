"""Geometry from plain RGB: a frozen Depth Anything 3 encoder (Lin et al., arXiv 2511.10647).

```
   variants      sizes, licences, and which of them a file holds
   blocks        rotary positions, attention, one transformer block
   backbone      images of several views -> features; parameter names are the released ones
   encoder       the backbone frozen: raw images in, features out
   source        Da3Source: an observation's cameras -> cells
```

Names, shapes and constants are those of the released weights and of the package `depth-anything-3` 0.1.1 (Apache-2.0), with
which tests/geometry/da3/test_upstream.py compares.
"""

from .backbone import Da3Backbone
from .encoder import Da3Encoder
from .source import Da3Source, default_image_size
from .variants import BACKBONE_PREFIX, OTHER_PREFIXES, VARIANTS, Da3Variant, variant_of

__all__ = [
    "BACKBONE_PREFIX",
    "OTHER_PREFIXES",
    "VARIANTS",
    "Da3Backbone",
    "Da3Encoder",
    "Da3Source",
    "Da3Variant",
    "default_image_size",
    "variant_of",
]
