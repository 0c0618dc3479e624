"""Geometry: from an observation to tokens of the geometry segment.

```
   depth maps, intrinsics, extrinsics        GeometrySource            GeometryAdapter
   ──────────────────────────────────► features (B, V, G, C)  ──►  tokens (B, V * G, W)
                                       validity (B, V, G)           padding mask (B, V * G)

   depth         raw depth of any layout and unit -> metres and valid pixels
   camera        calibration, point maps, rigid transforms        calibration   the JSON file
   source        the contract                                     rgbd, random_tokens   sources
   images        RGB of any layout -> (B, 3, H, W)                da3           a frozen encoder of RGB images, as a source
   adapter       features -> tokens, trainable                    encoder       source + adapter, and failing cameras
   store         a dataset's features, computed once
```

V cameras, G = grid x grid cells per camera. A cell with no valid measurement is masked, never zero; an absent camera is
left out of attention, never shown as black frames.
"""

from .calibration import read_calibration_file
from .camera import CameraCalibration
from .encoder import GeometryEncoder
from .source import GeometryFeatures, GeometrySource

__all__ = [
    "CameraCalibration",
    "GeometryEncoder",
    "GeometryFeatures",
    "GeometrySource",
    "read_calibration_file",
]
