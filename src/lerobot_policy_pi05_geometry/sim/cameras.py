"""Ranges of simulated camera poses, and MuJoCo's camera in OpenCV's convention."""

import math
from dataclasses import dataclass

import numpy as np

from ..geometry.camera import CameraCalibration
from .headless import mujoco

LOOK_AT = (0.0, 0.72, 0.08)  # metres, robot base frame: the middle of the table
BASE_AZIMUTH = 225.0  # degrees; at this azimuth the arm does not occlude the object
Interval = tuple[float, float]


@dataclass(frozen=True)
class CameraRange:
    """Camera poses on a sphere around `LOOK_AT`.

    azimuth: intervals of offsets from `BASE_AZIMUTH`, degrees; an interval is drawn in proportion to its length.
    elevation: degrees, negative looks down. distance: metres.
    """

    azimuth: tuple[Interval, ...]
    elevation: Interval = (-45.0, -30.0)
    distance: Interval = (1.05, 1.25)

    def draw(self, generator: np.random.Generator) -> mujoco.MjvCamera:
        """A camera pose of this range."""
        lengths = np.array([high - low for low, high in self.azimuth])
        share = lengths / lengths.sum() if lengths.sum() > 0 else np.full(len(lengths), 1 / len(lengths))
        low, high = self.azimuth[generator.choice(len(lengths), p=share)]
        camera = mujoco.MjvCamera()
        camera.lookat[:] = LOOK_AT
        camera.azimuth = BASE_AZIMUTH + generator.uniform(low, high)
        camera.elevation = generator.uniform(*self.elevation)
        camera.distance = generator.uniform(*self.distance)
        return camera


CAMERA_RANGES = {
    "fixed": CameraRange(((0.0, 0.0),), (-37.5, -37.5), (1.15, 1.15)),
    "train": CameraRange(((-15.0, 15.0),)),
    "outside": CameraRange(((-40.0, -20.0), (20.0, 40.0))),
    "far": CameraRange(((-65.0, -45.0), (45.0, 65.0))),
    "wide": CameraRange(((-40.0, 40.0),)),
}

_AZIMUTH = "azimuth"


def azimuth_range(degrees: float) -> str:
    """Name of the range of camera poses at one azimuth, an offset from `BASE_AZIMUTH`: "azimuth+30"."""
    return f"{_AZIMUTH}{degrees:+g}"


def find_range(name: str) -> CameraRange:
    """The range of this name: of `CAMERA_RANGES`, or `azimuth_range`'s, with elevation and distance as in training.

    Raises ValueError that lists the known names.
    """
    if name in CAMERA_RANGES:
        return CAMERA_RANGES[name]
    try:
        if name.startswith(_AZIMUTH) and math.isfinite(degrees := float(name.removeprefix(_AZIMUTH))):
            return CameraRange(((degrees, degrees),))
    except ValueError:
        pass
    raise ValueError(
        f"There is no camera range '{name}'; choose one of: {', '.join(CAMERA_RANGES)}, or {_AZIMUTH}+30 for one azimuth."
    )


def intrinsics(model: mujoco.MjModel, size: int) -> CameraCalibration:
    """Intrinsics of MuJoCo's free camera for square images; its pose comes with every frame."""
    focal = size / 2 / math.tan(math.radians(model.vis.global_.fovy) / 2)
    centre = (size - 1) / 2  # pixel (0, 0) has its centre at (0, 0)
    return CameraCalibration([focal, focal, centre, centre], [size, size])


def extrinsics(scene: mujoco.MjvScene) -> np.ndarray:
    """`base_T_camera`, (4, 4) float32, of the camera that a scene was last updated with.

    MuJoCo renders in stereo: the camera centre is midway between its two cameras.
    """
    left, right = scene.camera
    forward = np.asarray(left.forward, dtype=np.float64)
    up = np.asarray(left.up, dtype=np.float64)
    pose = np.eye(4)
    pose[:3, 0] = np.cross(forward, up)  # x right
    pose[:3, 1] = -up  # y down
    pose[:3, 2] = forward  # z forward
    pose[:3, 3] = (np.asarray(left.pos) + np.asarray(right.pos)) / 2
    return pose.astype(np.float32)
