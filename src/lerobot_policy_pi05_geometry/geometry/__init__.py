"""Geometry: from an observation to tokens of the geometry segment.

```
   depth maps, intrinsics, extrinsics        GeometrySource            GeometryAdapter
   ──────────────────────────────────► features (B, V, G, C)  ──►  tokens (B, V * G, W)
                                       validity (B, V, G)           padding mask (B, V * G)

   keys                 names of observations and cameras
   depth                raw depth of any layout and unit -> metres and valid pixels
   camera               one camera's calibration           point_map   depth -> 3-D points
   calibration          the calibration file               dataset_calibration   where a dataset keeps it
   images               RGB of any layout -> (B, 3, H, W)
   source               the interface of a source: observation -> features
   rgbd                 depth cameras                      da3/                  a frozen encoder of RGB images
   feature_store/       features of a dataset, computed once
   random_tokens        a control                          unknown_cameras       a converted checkpoint before training
   resolve              configuration + dataset -> source
   adapter              features -> tokens, trainable      encoder               source + adapter, and cameras that fail
```

V cameras, G = grid x grid cells per camera. A cell with no valid measurement is masked, and an absent
camera is left out of attention instead of being shown as black frames.
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
