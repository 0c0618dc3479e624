"""Where LIBERO's front camera may stand, and a MuJoCo camera in OpenCV terms.

The rule is LIBERO-Plus's (Fei et al., 2025, github.com/sylvestf/LIBERO-plus): the stock camera is turned about the
vertical axis through the workspace's centre, lifted about that centre, moved away from it, then turned and tilted about
itself. The wrist camera is part of the robot and never moved.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...geometry.camera import CameraCalibration

Interval = tuple[float, float]
# MuJoCo's cameras look along -z with y up; OpenCV's along z with y down.
_OPENCV_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class CameraMove:
    """One move of the stock camera: azimuth, lift, turn and tilt in degrees, distance as a factor."""

    azimuth: float = 0.0
    lift: float = 0.0
    distance: float = 1.0
    turn: float = 0.0
    tilt: float = 0.0

    def apply(self, pose: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        """pose: (4, 4), world_T_camera with OpenCV axes, metres. pivot: (3,), metres. Returns the moved pose, (4, 4)."""
        arm = pose[:3, 3] - pivot
        # Lifting turns the camera about the horizontal axis across its line of sight, upwards.
        heading = math.atan2(arm[1], arm[0])
        across = np.array([math.sin(heading), -math.cos(heading), 0.0])
        around = Rotation.from_rotvec(math.radians(self.azimuth) * np.array([0.0, 0.0, 1.0]))
        up = Rotation.from_rotvec(math.radians(self.lift) * across)
        turned = (around * up).as_matrix()
        own = Rotation.from_euler("yx", [self.turn, self.tilt], degrees=True).as_matrix()
        moved = np.eye(4)
        moved[:3, :3] = turned @ pose[:3, :3] @ own
        moved[:3, 3] = pivot + self.distance * (turned @ arm)
        return moved


@dataclass(frozen=True)
class CameraRange:
    """Moves to draw from. azimuth: intervals, drawn from in proportion to their length. Units as in `CameraMove`."""

    azimuth: tuple[Interval, ...] = ((0.0, 0.0),)
    lift: Interval = (0.0, 0.0)
    distance: Interval = (1.0, 1.0)
    turn: Interval = (0.0, 0.0)
    tilt: Interval = (0.0, 0.0)

    def draw(self, generator: np.random.Generator) -> CameraMove:
        """A move of this range."""
        lengths = np.array([high - low for low, high in self.azimuth])
        share = lengths / lengths.sum() if lengths.sum() > 0 else np.full(len(lengths), 1 / len(lengths))
        azimuth = self.azimuth[generator.choice(len(lengths), p=share)]
        intervals = (azimuth, self.lift, self.distance, self.turn, self.tilt)
        return CameraMove(*(float(generator.uniform(*interval)) for interval in intervals))


CAMERA_RANGES = {
    "fixed": CameraRange(),
    "train": CameraRange(((-15.0, 15.0),), (-5.0, 5.0), (0.95, 1.1), (-3.0, 3.0), (-3.0, 3.0)),
    "outside": CameraRange(((-40.0, -20.0), (20.0, 40.0)), (-5.0, 5.0), (0.95, 1.1), (-3.0, 3.0), (-3.0, 3.0)),
    "plus": CameraRange(((-75.0, 75.0),), (0.0, 15.0), (1.0, 2.0), (-10.0, 10.0), (-10.0, 10.0)),
}


def find_range(name: str) -> CameraRange:
    """The camera range of this name. Raises ValueError with the names there are."""
    if name not in CAMERA_RANGES:
        raise ValueError(f"There is no camera range '{name}'; choose one of: {', '.join(CAMERA_RANGES)}.")
    return CAMERA_RANGES[name]


def opencv_pose(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """MuJoCo's camera position (3,) and rotation (3, 3) -> world_T_camera (4, 4) with OpenCV axes."""
    pose = np.eye(4)
    pose[:3, :3] = np.asarray(rotation).reshape(3, 3) @ _OPENCV_FROM_MUJOCO
    pose[:3, 3] = position
    return pose


def mujoco_quaternion(pose: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z) of MuJoCo's camera for a pose with OpenCV axes, (4, 4)."""
    return Rotation.from_matrix(pose[:3, :3] @ _OPENCV_FROM_MUJOCO).as_quat(scalar_first=True)


def intrinsics(fovy: float, size: int) -> CameraCalibration:
    """Intrinsics of a MuJoCo camera with the vertical field of view `fovy`, degrees, for square images.

    Pixel (0, 0) has its centre at (0, 0), so the middle of the image is at (size - 1) / 2.
    """
    focal = size / 2 / math.tan(math.radians(fovy) / 2)
    centre = (size - 1) / 2
    return CameraCalibration([focal, focal, centre, centre], [size, size])
