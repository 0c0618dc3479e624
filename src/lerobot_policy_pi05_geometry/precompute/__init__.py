"""`pi05-geometry precompute`: a frozen encoder's features of every frame of a dataset, written to a store beside it.

```
   frames    the RGB frames of a LeRobotDataset, batch by batch, in order
   run       the store's files, one after the other; interrupted and started again, it continues where it stopped
```
"""

from .run import SHARD_FRAMES, Precompute, begin, disk_needed, prepare, verify

__all__ = ["SHARD_FRAMES", "Precompute", "begin", "disk_needed", "prepare", "verify"]
