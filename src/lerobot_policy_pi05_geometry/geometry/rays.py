"""Camera rays: where each cell's ray starts and where it points, without depth.

A control for depth: the policy knows the camera's pose as exactly as with `rgbd`, and measures nothing. Camera rays beside RGB
as in "Do You Know Where Your Camera Is?" (arXiv 2510.02268), there per pixel and as Plücker coordinates, here per cell and as
origin and direction.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from .camera import CameraCalibration
from .keys import RAW_STATE, batch_like, extrinsics_key
from .placed_camera import PlacedCamera
from .point_map import as_pose
from .rgbd import WAVELENGTHS
from .rigid import check_rigid
from .source import GeometryFeatures, GeometrySource

FEATURE_DIM = 6 + 2 * 6 * len(WAVELENGTHS)


class RaySource(GeometrySource):
    """Per cell: camera centre (3), unit direction (3) of the ray through the cell's centre, Fourier features of both.

    Both are in the robot's base frame, the centre in metres. placed: the cameras in token order. sizes: (H, W) of each image.
    """

    def __init__(self, placed: Sequence[PlacedCamera], grid: int, sizes: Mapping[str, tuple[int, int]]) -> None:
        super().__init__()
        self.cameras, self.grid, self.feature_dim = tuple(camera.name for camera in placed), grid, FEATURE_DIM
        self.placed = {camera.name: camera for camera in placed}
        directions = [
            torch.stack([camera_rays(on_rig, *sizes[camera.name], grid) for on_rig in camera.cameras])
            for camera in placed
        ]
        self._directions: Tensor  # (R, V, G, 3), in each camera's frame, for every rig
        self.register_buffer("_directions", torch.stack(directions, dim=1), persistent=False)

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return [camera for camera in self.cameras if not self._has_pose(camera, batch)]

    def _has_pose(self, camera: str, batch: Mapping[str, Tensor]) -> bool:
        placed = self.placed[camera]
        return extrinsics_key(camera) in batch or (placed.placed and (not placed.on_arm or RAW_STATE in batch))

    def missing_message(self, cameras: list[str]) -> str:
        keys = ", ".join(RAW_STATE if self.placed[camera].on_arm else extrinsics_key(camera) for camera in cameras)
        return (
            f"The observation has no pose of camera(s) {', '.join(cameras)}, which have no extrinsics in their calibration: "
            f"expected {keys}; add extrinsics to the calibration, or the pose to every observation (processors of new "
            "checkpoints copy the raw state)."
        )

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        like = batch_like(batch)
        missing = self.missing_cameras(batch)
        rows = self.placed[self.cameras[0]].rows(batch)  # the same for all cameras
        if check:
            self.placed[self.cameras[0]].check_rigs(batch)
        poses = [
            torch.full((4, 4), float("nan"), device=like.device)
            if camera in missing
            else self._pose(camera, batch, rows, check, like.device)
            for camera in self.cameras
        ]
        pose = torch.stack([p.expand(like.shape[0], 4, 4) for p in poses], dim=1)  # (B, V, 4, 4)
        directions = self._directions.to(like.device)
        return ray_features(pose, directions[0] if rows is None else directions.index_select(0, rows.to(like.device)))

    def _pose(
        self, camera: str, batch: Mapping[str, Tensor], rows: Tensor | None, check: bool, device: torch.device
    ) -> Tensor:
        """`base_T_camera`, (B, 4, 4) or (4, 4): from the batch, or from the calibration."""
        key = extrinsics_key(camera)
        if key not in batch:
            return self.placed[camera].poses(batch, rows, device)
        pose = as_pose(batch[key], key)
        if check:  # a pose that is not known masks its camera; in training it is a fault of the data
            check_rigid(pose if self.training else pose[pose.isfinite().flatten(-2).all(dim=-1)], key)
        return self.placed[camera].frame_poses(pose, rows).to(torch.float32)


def camera_rays(calibration: CameraCalibration, height: int, width: int, grid: int) -> Tensor:
    """Unit directions (G, 3) in the camera's frame of the rays through the cells' centres of an image (height, width)."""
    fx, fy, cx, cy = calibration.scaled_intrinsics(height, width)
    cells = torch.arange(grid, dtype=torch.float64) + 0.5
    v, u = cells * height / grid - 0.5, cells * width / grid - 0.5  # pixel centres are at integers
    x = ((u - cx) / fx).expand(grid, grid)
    y = ((v - cy) / fy)[:, None].expand(grid, grid)
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3)
    return (rays / rays.norm(dim=-1, keepdim=True)).float()


def ray_features(pose: Tensor, directions: Tensor) -> GeometryFeatures:
    """Features of rays. pose: `base_T_camera` (B, V, 4, 4). directions: (V, G, 3) or (B, V, G, 3) in the cameras' frames.

    A camera whose pose is not finite has no valid cell.
    """
    seen = pose.isfinite().flatten(2).all(dim=-1)  # (B, V)
    pose = torch.where(seen[..., None, None], pose, torch.zeros_like(pose))
    # Products and sums one by one: a matrix product would be rounded to TF32 on a GPU.
    direction = (pose[..., None, :3, :3] * directions[..., None, :]).sum(dim=-1)
    origin = pose[..., None, :3, 3].expand_as(direction)
    rays = torch.cat([origin, direction], dim=-1)  # (B, V, G, 6)
    angles = torch.cat([rays * (2 * torch.pi / wavelength) for wavelength in WAVELENGTHS], dim=-1)
    features = torch.cat([rays, angles.sin(), angles.cos()], dim=-1)
    valid = seen[..., None].expand(features.shape[:3])
    return GeometryFeatures(features.masked_fill(~valid[..., None], 0.0), valid)
