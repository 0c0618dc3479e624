"""Pinhole cameras: calibration, depth to points, rigid transforms.

Axes are OpenCV's: x right, y down, z forward along the optical axis. Pixel (0, 0) has its centre at (0, 0). Extrinsics
are `base_T_camera`: they map points from the camera into the robot's base frame, in metres.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

RIGID_TOLERANCE = 1e-3


@dataclass
class CameraCalibration:
    """One camera. intrinsics: fx, fy, cx, cy in pixels of an image of `size` (width, height).

    extrinsics: `base_T_camera`, 4 rows of 4, or None for a camera whose pose comes with every frame.
    """

    intrinsics: list[float]
    size: list[int]
    extrinsics: list[list[float]] | None = None

    def check(self, name: str) -> None:
        """Raise ValueError, naming the camera, unless this is a usable calibration."""
        if len(self.intrinsics) != 4 or not all(math.isfinite(v) for v in self.intrinsics):
            raise ValueError(
                f"Intrinsics of camera '{name}' must be four finite numbers fx, fy, cx, cy; got {self.intrinsics}."
            )
        fx, fy = self.intrinsics[:2]
        if fx <= 0 or fy <= 0:
            raise ValueError(
                f"Intrinsics of camera '{name}' are singular: fx and fy must be above 0, got {fx} and {fy}."
            )
        if len(self.size) != 2 or min(self.size) < 1:
            raise ValueError(f"Size of camera '{name}' must be [width, height] in pixels, got {self.size}.")
        if self.extrinsics is not None:
            pose = torch.tensor(self.extrinsics, dtype=torch.float64)
            check_rigid(pose, f"Extrinsics of camera '{name}'")

    def scaled_intrinsics(self, height: int, width: int) -> list[float]:
        """fx, fy, cx, cy for the same view resized to (height, width)."""
        fx, fy, cx, cy = self.intrinsics
        sx, sy = width / self.size[0], height / self.size[1]
        # Pixel centres are at integers, so the image's corner is at -0.5: that is the point which scales.
        return [fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5]


def check_rigid(pose: Tensor, what: str) -> None:
    """Raise ValueError unless pose, (..., 4, 4), is rotation and translation."""
    if pose.shape[-2:] != (4, 4):
        raise ValueError(f"{what} must be 4 x 4, got shape {tuple(pose.shape)}.")
    pose = pose.detach().cpu().double()
    rotation = pose[..., :3, :3]
    error = (rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().amax(dim=(-1, -2))
    last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    error = torch.maximum(error, (pose[..., 3, :] - last_row).abs().amax(dim=-1))
    good = pose.isfinite().all(dim=-1).all(dim=-1) & (error < RIGID_TOLERANCE) & (torch.linalg.det(rotation) > 0)
    if not good.all():
        raise ValueError(
            f"{what} must be a rigid transform (a rotation matrix with determinant 1, a translation in metres, and the "
            f"last row 0 0 0 1): the error is {error.max().item():.3g}; give base_T_camera with OpenCV axes."
        )


def unproject(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Depth to points in the camera frame.

    depth: (B, 1, H, W) metres along the optical axis. intrinsics: (4,) or (B, 4), fx, fy, cx, cy for this image size.
    Returns (B, 3, H, W) metres: x = (u - cx) z / fx, y = (v - cy) z / fy, z.
    """
    height, width = depth.shape[-2:]
    v = torch.arange(height, device=depth.device, dtype=depth.dtype)[:, None]
    u = torch.arange(width, device=depth.device, dtype=depth.dtype)[None, :]
    fx, fy, cx, cy = intrinsics.to(depth).unbind(-1)
    fx, fy, cx, cy = (value.reshape(-1, 1, 1, 1) for value in (fx, fy, cx, cy))
    return torch.cat([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], dim=1)


def as_pose(pose: Tensor, key: str) -> Tensor:
    """A pose as it stands in a batch -> (4, 4) for the whole batch, or (B, 4, 4).

    Datasets store a pose as 16 numbers, row by row: LeRobot's tools cannot edit columns of more than one dimension.
    Environments, and datasets of earlier versions of this package, give 4 x 4.
    """
    if pose.shape[-1:] == (16,):
        return pose.unflatten(-1, (4, 4))
    if pose.shape[-2:] == (4, 4):
        return pose
    raise ValueError(
        f"{key} must be base_T_camera, as 16 numbers row by row or as 4 x 4, got shape {tuple(pose.shape)}."
    )


def transform(pose: Tensor, points: Tensor) -> Tensor:
    """Map points (B, 3, H, W) through poses (4, 4) or (B, 4, 4).

    Written as products of numbers and not as a matrix product: `allow_tf32`, which lerobot-train sets, rounds the factors
    of matrix products to 10 bits, and a point 1 m away would move by up to 0.9 mm.
    """
    pose = pose.to(points).expand(points.shape[0], 4, 4)[..., None, None]  # (B, 4, 4, 1, 1)
    x, y, z = points[:, 0:1], points[:, 1:2], points[:, 2:3]  # (B, 1, H, W)
    moved = torch.addcmul(pose[:, :3, 3], pose[:, :3, 0], x)
    return moved.addcmul_(pose[:, :3, 1], y).addcmul_(pose[:, :3, 2], z)
