"""Features of every frame of a dataset, computed once and read in every epoch of training.

```
   fingerprint   a dataset's tables and files -> what tells it from a changed one
   manifest      manifest.json: what the features depend on, and how they are laid out
   shards        the files of features: written so that an interruption loses nothing, read through a memory map
   reader        FeatureStore: frames by dataset index, shuffled
   source        FeatureStoreSource: the store as a geometry source
   match         a store for a policy and a dataset
```

A store is a folder of plain files. One frame is one record: its features, bfloat16, (V, G, C) row-major, little-endian, and a
CRC-32 of them.

No library's format served. safetensors and npy put the size in a header before the data: a file cannot grow batch by batch.
Parquet and Arrow, LeRobot's own tables, write row groups that only a footer makes readable: an interruption loses them, and
one shuffled frame decodes a whole group. HDF5 files are damaged by a kill in the middle of a write. LMDB and Zarr survive one,
but copy or decompress every record that is read, and do not checksum it. Here a file grows by appending, its checksums say
after a crash how many frames are good, and a frame is one read of a memory map.
"""

from .manifest import Manifest, read_manifest
from .reader import FeatureStore
from .source import FeatureStoreSource

__all__ = ["FeatureStore", "FeatureStoreSource", "Manifest", "read_manifest"]
