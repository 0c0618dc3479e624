"""Features of every frame of a dataset, computed once and read ever after.

```
   fingerprint   a dataset's files -> what tells it from a changed one
   manifest      manifest.json: what the features depend on, and how they are laid out
   shards        the files of features: written so that an interruption loses nothing, read through a memory map
   reader        FeatureStore: frames by dataset index, shuffled
   source        FeatureStoreSource: the store as a geometry source
```

A store is a folder of plain files. One frame is one record: its features, bfloat16, (V, G, C) row-major, little-endian, and a
CRC-32 of them. Plain records and not safetensors, whose header needs the whole size in advance: a shard grows by appending, and
what is in it after a crash says by itself how far it is good.
"""

from .manifest import Manifest, read_manifest
from .reader import FeatureStore
from .source import FeatureStoreSource

__all__ = ["FeatureStore", "FeatureStoreSource", "Manifest", "read_manifest"]
