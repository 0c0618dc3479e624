"""The calibration file: how a real robot's user says what LeRobot drops when recording.

```json
{"frame": "base", "cameras": {"front": {"intrinsics": [600.0, 600.0, 319.5, 239.5], "size": [640, 480],
                                        "extrinsics": [[...], [...], [...], [0, 0, 0, 1]]}}}
```

`extrinsics` is null for a camera whose pose comes with every frame, as `observation.calibration.<cam>.extrinsics`.
"""

import json
from pathlib import Path

from .camera import CameraCalibration

CALIBRATION_FILE = "calibration.json"
_CAMERA_FIELDS = {"intrinsics", "size", "extrinsics"}


def read_calibration_file(path: str | Path) -> dict[str, CameraCalibration]:
    """Read and check a calibration file. Raises FileNotFoundError or ValueError with one sentence that says what is off."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"Calibration file {path} is not there; set --policy.calibration_path to an existing file."
        )
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"Calibration file {path} is no JSON: {error}.") from error
    if (
        not isinstance(content, dict)
        or set(content) != {"frame", "cameras"}
        or not isinstance(content["cameras"], dict)
    ):
        raise ValueError(f"Calibration file {path} must be an object with the entries 'frame' and 'cameras'.")
    if content["frame"] != "base":
        raise ValueError(
            f"Calibration file {path} gives extrinsics in frame {content['frame']!r}; only 'base', the robot's base, is known."
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


def write_calibration_file(path: str | Path, cameras: dict[str, CameraCalibration]) -> None:
    """Write a calibration file that `read_calibration_file` reads back."""
    entries = {name: vars(camera) for name, camera in cameras.items()}
    Path(path).write_text(json.dumps({"frame": "base", "cameras": entries}, indent=2) + "\n")
