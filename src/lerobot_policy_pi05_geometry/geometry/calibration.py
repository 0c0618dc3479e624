"""The calibration file: how a real robot's user says what LeRobot drops when recording.

```json
{"version": 2, "frame": "base",
 "cameras": {"front": {"intrinsics": [600.0, 600.0, 319.5, 239.5], "size": [640, 480], "depth_scale": 0.001,
                       "extrinsics": [[...], [...], [...], [0, 0, 0, 1]]},
             "wrist": {"intrinsics": [...], "size": [640, 480], "depth_scale": 0.0001,
                       "mount": {"arm": "arm", "link": "gripper", "link_T_camera": [[...], ...]}}},
 "arms": {"arm": {"links": [...], "joints": [...]}}}
```

A camera has `extrinsics`, or a `mount` on a moving arm, or neither where its pose comes with every frame, as
`observation.calibration.<cam>.extrinsics`. `camera.py` and `kinematics.py` say what the entries mean. Files without a
`version` have the entries `frame` and `cameras` only. The same entries stand in a dataset's meta/info.json
(dataset_calibration.py). A file for data of several robots has `rigs` instead: an object from a
rig's name to its `cameras` and `arms`; the dataset says with every frame, as `observation.calibration.rig`, which one it is.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import draccus
from draccus.utils import DecodingError

from ..weight_files.files import write_whole
from .camera import CameraCalibration
from .keys import RIG
from .kinematics import Arm, ForwardKinematics

CALIBRATION_FILE = "calibration.json"
VERSION = 2
BASE_FRAME = "base"


@dataclass
class Rig:
    """One robot with its cameras. cameras, arms: by name."""

    cameras: dict[str, CameraCalibration] = field(default_factory=dict)
    arms: dict[str, Arm] = field(default_factory=dict)

    def check(self) -> None:
        """Raise ValueError unless every camera and arm is usable, and every mount is on a link that the state moves."""
        for name, arm in self.arms.items():
            arm.check(name)
        for name, camera in self.cameras.items():
            camera.check(name)
            if camera.mount is not None:
                self._check_mount(name, camera)

    def _check_mount(self, name: str, camera: CameraCalibration) -> None:
        mount = camera.mount
        assert mount is not None
        if mount.arm not in self.arms:
            known = ", ".join(self.arms) or "no arm"
            raise ValueError(f"Camera '{name}' is mounted on arm '{mount.arm}', but the calibration has {known}.")
        arm = self.arms[mount.arm]
        if mount.link not in [link.name for link in arm.links]:
            raise ValueError(
                f"Camera '{name}' is mounted on link '{mount.link}', which arm '{mount.arm}' does not have."
            )
        unknown = ForwardKinematics(arm, [mount.link]).unknown_joints
        if unknown:
            raise ValueError(
                f"Camera '{name}' is moved by joint(s) {', '.join(unknown)} of arm '{mount.arm}', but the calibration does not "
                "say which state entry they are; add them to the arm's joints."
            )


@dataclass
class Calibration(Rig):
    """What a calibration file says: one rig, or, for data of several robots, `rigs` by name and nothing else."""

    rigs: dict[str, Rig] = field(default_factory=dict)

    def check(self) -> None:
        """Raise ValueError unless all of it is usable."""
        super().check()
        for name, rig in self.rigs.items():
            try:
                rig.check()
            except ValueError as error:
                raise ValueError(f"Rig '{name}': {error}") from error


def read_calibration_file(path: str | Path) -> Calibration:
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
    return parse_calibration(content, f"Calibration file {path}")


def parse_calibration(content: Any, where: str) -> Calibration:
    """The content of a calibration file, as JSON reads it. where: says in messages where it stood."""
    entries = set(content) if isinstance(content, dict) else set()
    version = content.get("version", 1) if isinstance(content, dict) else 1
    allowed = {"frame", "cameras"} if version == 1 else {"version", "frame", "cameras", "arms"}
    if version == VERSION and "rigs" in entries:
        allowed = {"version", "frame", "rigs"}
    if version not in (1, VERSION):
        raise ValueError(f"{where} has version {version!r}; this package reads 1 and {VERSION}.")
    if not {"frame"} <= entries <= allowed or not {"cameras", "rigs"} & entries:
        raise ValueError(
            f"{where} must be an object with the entries 'frame' and 'cameras' (with \"version\": 2 also 'arms', or 'rigs' "
            "instead of both)."
        )
    if content["frame"] != BASE_FRAME:
        raise ValueError(
            f"{where} gives extrinsics in frame {content['frame']!r}; only 'base', the robot's base, is known."
        )
    rigs = {}
    for name, entry in _object(content.get("rigs", {}), where, "rigs").items():
        told = f"Rig '{name}' of {where}"
        if not name.isdecimal() or str(int(name)) != name:  # "01" would be another name of rig 1
            raise ValueError(
                f"{told}: rigs are numbered, as the data's {RIG} has them; give a whole number as its name, as 1 and not "
                "01."
            )
        if not isinstance(entry, dict) or not {"cameras"} <= set(entry) <= {"cameras", "arms"}:
            raise ValueError(f"{told} must be an object with the entries 'cameras' and 'arms'.")
        rigs[name] = Rig(*_parse_rig(entry, told))
    calibration = Calibration(*_parse_rig(content, where), rigs)
    try:
        calibration.check()
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return calibration


def _parse_rig(content: Mapping[str, Any], where: str) -> tuple[dict[str, CameraCalibration], dict[str, Arm]]:
    cameras = {
        name: _decode(CameraCalibration, entry, f"Camera '{name}' in {where}")
        for name, entry in _object(content.get("cameras", {}), where, "cameras").items()
    }
    arms = {
        name: _decode(Arm, entry, f"Arm '{name}' in {where}")
        for name, entry in _object(content.get("arms", {}), where, "arms").items()
    }
    return cameras, arms


def _object(value: Any, where: str, entry: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: the entries 'frame' and 'cameras' are needed, and '{entry}' must be an object.")
    return value


def _decode[T](kind: type[T], entry: Any, where: str) -> T:
    if not isinstance(entry, dict):
        raise ValueError(f"{where} must be an object, got {entry!r}.")
    try:
        decoded: T = draccus.decode(kind, entry)
    except (DecodingError, AttributeError, OverflowError) as error:
        first = str(error).splitlines()[0].rstrip(".:")
        raise ValueError(f"{where} cannot be read: {first}.") from error
    return decoded


def calibration_content(calibration: Rig) -> dict[str, Any]:
    """What `parse_calibration` reads back, of one rig or of a whole calibration."""
    content: dict[str, Any] = {"version": VERSION, "frame": BASE_FRAME}
    if isinstance(calibration, Calibration) and calibration.rigs:
        return content | {"rigs": {name: asdict(rig) for name, rig in calibration.rigs.items()}}
    return content | asdict(Rig(calibration.cameras, calibration.arms))


def write_calibration_file(path: str | Path, calibration: Rig) -> None:
    """Write a calibration file that `read_calibration_file` reads back; whole, or not at all."""
    calibration.check()
    write_whole(Path(path), json.dumps(calibration_content(calibration), indent=2) + "\n")
