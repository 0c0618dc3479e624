"""Pinhole cameras: their calibration (point_map.py makes points of their depth).

Axes are OpenCV's: x right, y down, z forward along the optical axis. Pixel (0, 0) has its centre at (0, 0). Extrinsics
are `base_T_camera`: they map points from the camera into the robot's base frame, in metres.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from .rigid import as_matrix

STREAMS = ("depth", "color")
FOCAL_LENGTHS = (0.1, 20.0)  # in image sides: from a field of view of 157 degrees to one of 3
CENTRES = (-1.0, 2.0)  # of the optical axis, in image sides: a cropped image may have it outside
# A factor by which images may be wider or higher than the calibration's size says: sizes are whole pixels.
SQUEEZE = 1.03
ROTATIONS = (0, 90, 180, 270)  # degrees clockwise, as LeRobot's cameras have it (270 is its -90)


@dataclass
class Mount:
    """Where a camera sits on a moving arm. arm: its name in the calibration. link_T_camera: 4 rows of 4, metres."""

    arm: str
    link: str
    link_T_camera: list[list[float]]  # noqa: N815  the field's name in robotics


@dataclass
class ColorStream:
    """The colour stream of a camera whose calibration holds for the depth stream.

    intrinsics, size: as of the camera. distortion: OpenCV's k1, k2, p1, p2, k3. depth_T_color: 4 rows of 4, metres.
    """

    intrinsics: list[float]
    size: list[int]
    depth_T_color: list[list[float]]  # noqa: N815
    distortion: list[float]

    def check(self, name: str) -> None:
        """Raise ValueError, naming the camera, unless these are usable numbers."""
        _check_intrinsics(self.intrinsics, self.size, f"colour stream of camera '{name}'")
        if len(self.distortion) != 5 or not all(math.isfinite(value) for value in self.distortion):
            raise ValueError(f"Distortion of the colour stream of camera '{name}' must be five finite numbers.")
        as_matrix(self.depth_T_color, f"depth_T_color of camera '{name}'")


@dataclass
class CameraCalibration:
    """One camera. All of it holds for the sensor, before `rotation`.

    intrinsics: fx, fy, cx, cy in pixels of an image of `size` (width, height). extrinsics: `base_T_camera`, 4 rows of 4, or
    None for a camera whose pose comes with every frame or that has a `mount` on a moving arm. depth_scale: metres of one
    count of the raw depth (0.001 of a D435, 0.0001 of a D405); None for depth whose declared unit is true. stream: which
    stream the numbers hold for; "color" also for depth that was aligned to colour. rotation: degrees clockwise by which
    recorded images were turned (LeRobot's camera setting). color: the colour stream, where it is another one.
    """

    intrinsics: list[float]
    size: list[int]
    extrinsics: list[list[float]] | None = None
    mount: Mount | None = None
    depth_scale: float | None = None
    stream: str = "depth"
    rotation: int = 0
    color: ColorStream | None = None

    def check(self, name: str) -> None:
        """Raise ValueError, naming the camera, unless this is a usable calibration."""
        _check_intrinsics(self.intrinsics, self.size, f"camera '{name}'")
        if self.extrinsics is not None:
            as_matrix(self.extrinsics, f"Extrinsics of camera '{name}'")
        if self.mount is not None:
            if self.extrinsics is not None:
                raise ValueError(
                    f"Camera '{name}' has both extrinsics and a mount; a camera on a moving arm has a mount only."
                )
            as_matrix(self.mount.link_T_camera, f"link_T_camera of camera '{name}'")
        if self.depth_scale is not None and not 1e-6 <= self.depth_scale <= 0.1:
            raise ValueError(
                f"depth_scale of camera '{name}' must be the metres of one count of its raw depth (0.001 of a D435, 0.0001 of "
                f"a D405), got {self.depth_scale}."
            )
        if self.stream not in STREAMS:
            raise ValueError(f"Stream of camera '{name}' must be {' or '.join(STREAMS)}, got {self.stream!r}.")
        if self.rotation not in ROTATIONS:
            raise ValueError(f"Rotation of camera '{name}' must be 0, 90, 180 or 270 degrees, got {self.rotation}.")
        if self.color is not None:
            self.color.check(name)

    def scaled_intrinsics(self, height: int, width: int) -> list[float]:
        """fx, fy, cx, cy for the same view resized to (height, width)."""
        fx, fy, cx, cy = self.intrinsics
        sx, sy = width / self.size[0], height / self.size[1]
        # Pixel centres are at integers, so the image's corner is at -0.5: that is the point which scales.
        return [fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5]

    def check_view(self, name: str, height: int, width: int) -> None:
        """Raise ValueError unless images (height, width), turned as recorded, may be this view resized.

        A cropped or turned image has another shape, and intrinsics that no scale tells.
        """
        one_pixel = 1 + 1.0 / min(height, width)
        squeeze = (width * self.size[1]) / (height * self.size[0])
        if not 1 / max(SQUEEZE, one_pixel) <= squeeze <= max(SQUEEZE, one_pixel):
            raise ValueError(
                f"Images of camera '{name}' are {width} x {height}, but its calibration is of {self.size[0]} x {self.size[1]}, "
                "another shape; give the intrinsics of the mode that was recorded (`pi05-geometry calibrate camera`), and "
                "'rotation' in the calibration if images were turned. For images that were squeezed, scale fx, cx and fy, cy and "
                "give their size."
            )

    def as_recorded(self) -> "CameraCalibration":
        """The same camera for images as they were recorded: turned by `rotation`, which is 0 in what is returned.

        Turning an image turns its axes: the pixel axes in intrinsics and size, x and y in every pose.
        """
        turned = self
        for _ in range(self.rotation // 90):
            turned = replace(
                turned,
                intrinsics=_quarter_turn(turned.intrinsics, turned.size),
                size=turned.size[::-1],
                extrinsics=None if turned.extrinsics is None else _times_turn(turned.extrinsics),
                mount=None
                if turned.mount is None
                else replace(turned.mount, link_T_camera=_times_turn(turned.mount.link_T_camera)),
                color=None if turned.color is None else _turned_color(turned.color),
            )
        return replace(turned, rotation=0)


# Camera axes of an image turned clockwise by a quarter: its x axis is the sensor's -y, its y axis the sensor's x.
# In NumPy, since the planner builds cameras where torch's tensors hold no values.
_SENSOR_T_TURNED = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def sensor_T_images(rotation: int) -> list[list[float]]:  # noqa: N802
    """Pose in the sensor's frame of images that were turned by `rotation` degrees clockwise, 4 rows of 4."""
    rows: list[list[float]] = np.linalg.matrix_power(_SENSOR_T_TURNED, rotation // 90).tolist()
    return rows


def pose_of_sensor(pose: np.ndarray, rotation: int) -> np.ndarray:
    """The sensor's pose (4, 4) from that of its images, which were turned by `rotation` degrees clockwise."""
    for _ in range(rotation // 90):
        pose = pose @ _SENSOR_T_TURNED.T
    return pose


def _quarter_turn(intrinsics: list[float], size: list[int]) -> list[float]:
    """Pixel (u, v) of the sensor is pixel (height - 1 - v, u) of the image turned clockwise."""
    fx, fy, cx, cy = intrinsics
    return [fy, fx, size[1] - 1 - cy, cx]


def _times_turn(pose: list[list[float]]) -> list[list[float]]:
    turned: list[list[float]] = (np.array(pose) @ _SENSOR_T_TURNED).tolist()
    return turned


def _turned_color(color: ColorStream) -> ColorStream:
    k1, k2, p1, p2, k3 = color.distortion
    depth_T_color = _SENSOR_T_TURNED.T @ np.array(color.depth_T_color) @ _SENSOR_T_TURNED
    return ColorStream(
        _quarter_turn(color.intrinsics, color.size),
        color.size[::-1],
        depth_T_color.tolist(),
        [k1, k2, p2, -p1, k3],  # x' = -y, y' = x in OpenCV's tangential terms
    )


def _check_intrinsics(intrinsics: list[float], size: list[int], what: str) -> None:
    if len(intrinsics) != 4 or not all(math.isfinite(v) for v in intrinsics):
        raise ValueError(f"Intrinsics of {what} must be four finite numbers fx, fy, cx, cy; got {intrinsics}.")
    fx, fy = intrinsics[:2]
    if fx <= 0 or fy <= 0:
        raise ValueError(f"Intrinsics of {what} are singular: fx and fy must be above 0, got {fx} and {fy}.")
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"Size of {what} must be [width, height] in pixels, got {size}.")
    for focal, centre, side in zip(intrinsics[:2], intrinsics[2:], size, strict=True):
        low, high = FOCAL_LENGTHS
        if not low <= focal / side <= high or not CENTRES[0] <= centre / side <= CENTRES[1]:
            raise ValueError(
                f"Intrinsics of {what} are no pixels of an image of {size[0]} x {size[1]}: fx, fy, cx, cy are {intrinsics}; give "
                "them for that size."
            )
