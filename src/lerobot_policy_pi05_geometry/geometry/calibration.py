"""The calibration file: intrinsics and poses of cameras, which LeRobot does not record.

```json
{"frame": "base", "cameras": {"front": {"intrinsics": [600.0, 600.0, 319.5, 239.5], "size": [640, 480],
                                        "extrinsics": [[...], [...], [...], [0, 0, 0, 1]]}}}
```

`extrinsics` is null for a camera whose pose comes with every frame, as `observation.calibration.<cam>.extrinsics`.
The same entries stand in a dataset's meta/info.json (dataset_calibration.py).
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .camera import CameraCalibration

CALIBRATION_FILE = "calibration.json"
BASE_FRAME = "base"
_CAMERA_FIELDS = {"intrinsics", "size", "extrinsics"}


def read_calibration_file(path: str | Path) -> dict[str, CameraCalibration]:
    """Read and check a calibration file. Raises FileNotFoundError or ValueError with one sentence on what is wrong."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"Calibration file {path} does not exist; set --policy.calibration_path to an existing file."
        )
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"Calibration file {path} is not valid JSON: {error}.") from error
    return parse_calibration(content, path)


def parse_calibration(content: Any, path: Path) -> dict[str, CameraCalibration]:
    """Check the content of a calibration file and return its cameras. path: where it is from, for messages."""
    if (
        not isinstance(content, dict)
        or set(content) != {"frame", "cameras"}
        or not isinstance(content["cameras"], dict)
    ):
        raise ValueError(f"The calibration in {path} must be an object with the entries 'frame' and 'cameras'.")
    if content["frame"] != BASE_FRAME:
        raise ValueError(
            f"The calibration in {path} gives extrinsics in frame {content['frame']!r}; only 'base', the robot's base, is known."
        )
    cameras = {}
    for name, entry in content["cameras"].items():
        if not isinstance(entry, dict) or not {"intrinsics", "size"} <= set(entry) <= _CAMERA_FIELDS:
            raise ValueError(
                f"Camera '{name}' in {path} needs the entries 'intrinsics', 'size' and 'extrinsics' (may be null)."
            )
        try:
            extrinsics = entry.get("extrinsics")
            camera = CameraCalibration(
                [float(v) for v in entry["intrinsics"]],
                [int(v) for v in entry["size"]],
                None if extrinsics is None else [[float(v) for v in row] for row in extrinsics],
            )
            if camera.extrinsics is not None and [len(row) for row in camera.extrinsics] != [4, 4, 4, 4]:
                raise ValueError(f"Extrinsics of camera '{name}' must be 4 rows of 4 numbers.")
            camera.check(name)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"Camera '{name}' in {path}: {str(error).rstrip('.')}.") from error
        cameras[name] = camera
    return cameras


def calibration_content(cameras: Mapping[str, CameraCalibration]) -> dict[str, Any]:
    """What a calibration file says about these cameras, as JSON values."""
    return {"frame": BASE_FRAME, "cameras": {name: vars(camera) for name, camera in cameras.items()}}


def write_calibration_file(path: str | Path, cameras: Mapping[str, CameraCalibration]) -> None:
    """Write a calibration file that `read_calibration_file` reads back."""
    Path(path).write_text(json.dumps(calibration_content(cameras), indent=2) + "\n")
