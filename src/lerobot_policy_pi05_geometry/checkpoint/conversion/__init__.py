"""π0.5 checkpoints of LeRobot and openpi -> ours, ours -> ours with another geometry, and ours -> LeRobot's.

```
   names         which tensor of theirs is which of ours: pure, no files
   tensor_file   safetensors files copied tensor by tensor, as bytes
   settings      the configurations' fields, both ways
   processors    the processors' JSON and statistics, both ways
   start         values of the parameters that π0.5 does not have
   geometry_start   the geometry that was asked for, as configuration fields
   to_ours       convert: theirs -> ours
   other_geometry   convert: ours -> ours with another geometry
   to_lerobot    export: ours -> LeRobot's
```

Weights are never loaded: bytes go from file to file in the dtype that they are stored in, so both ways are exact and need
no memory to speak of. A checkpoint is written beside its place and renamed when it is complete.
"""

from .geometry_start import GeometryStart
from .to_lerobot import export
from .to_ours import convert

__all__ = ["GeometryStart", "convert", "export"]
