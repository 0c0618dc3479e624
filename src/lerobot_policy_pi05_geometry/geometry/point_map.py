"""From a depth image to 3-D points: one point for every pixel, in the camera's frame, then in the robot's base frame.

Axes are OpenCV's: x right, y down, z forward along the optical axis. Pixel (0, 0) has its centre at (0, 0).
"""

import torch
from torch import Tensor


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


def placed_points(depth: Tensor, intrinsics: Tensor, pose: Tensor | None) -> Tensor:
    """Depth to points in the frame that a pose leads to: `transform(pose, unproject(depth, intrinsics))` in one pass over pixels.

    depth, intrinsics: as in `unproject`. pose: (4, 4) or (B, 4, 4), or None for the camera frame. Returns (B, 3, H, W) metres.

    A point is the depth times a direction, which depends on column and row, plus the camera's place. As in `transform`, these
    are products of numbers.
    """
    height, width = depth.shape[-2:]
    pose = torch.eye(4, device=depth.device) if pose is None else pose
    turn, place = pose.to(depth)[..., :3, :3], pose.to(depth)[..., :3, 3].reshape(-1, 3, 1, 1)
    x, y, z = (axis.reshape(-1, 3, 1, 1) for axis in turn.unbind(-1))  # of the camera, in the frame
    fx, fy, cx, cy = (value.reshape(-1, 1, 1, 1) for value in intrinsics.to(depth).unbind(-1))
    u = torch.arange(width, device=depth.device, dtype=depth.dtype)[None, :]
    v = torch.arange(height, device=depth.device, dtype=depth.dtype)[:, None]
    directions = (x * ((u - cx) / fx) + z) + y * ((v - cy) / fy)  # (1 or B, 3, H, W)
    return torch.addcmul(place, directions, depth)


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
