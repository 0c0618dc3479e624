"""Geometry from depth cameras: metric depth -> point map -> per-cell statistics.

Points in the robot's base frame do not depend on the camera's pose. Points in the camera frame do: the network then has to
learn the pose, and success falls where the camera stands elsewhere than in training (docs/results.md).
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from .depth import check_measured, check_unit, to_metres
from .depth_augmentation import DepthAugmentation, augment_depth, jittered
from .keys import AUGMENTATION_KEY, RAW_STATE, depth_key, extrinsics_key, find_depth_key
from .placed_camera import PlacedCamera
from .point_map import as_pose, placed_points
from .rigid import check_rigid
from .source import GeometryFeatures, GeometrySource

# Wavelengths of the Fourier features of a point, in metres: from a workspace down to the width of a finger.
WAVELENGTHS = tuple(8.0 / 2**k for k in range(8))
FEATURE_DIM = 7 + 6 * len(WAVELENGTHS)
SAMPLES = 4  # points per side of a cell, where features are points


class RgbdSource(GeometrySource):
    """Per cell: mean point (3), spread (3), fraction of valid pixels (1), Fourier features of the mean (6 per wavelength).

    as_points: instead, 16 points of the cell, which the adapter pools.
    placed: the cameras in token order. sizes: (H, W) of each camera's depth. base_frame: points in the robot's base instead of
    the camera. unit, max_depth, bounds (by camera): see `depth.to_metres`. depth_keys: see `keys.find_depth_key`.
    optional: cameras that any observation may lack. augmentation: of training batches that have `AUGMENTATION_KEY`.
    Sources: Fourier features as in NeRF (Mildenhall et al., 2020), with wavelengths in metres.
    """

    def __init__(
        self,
        placed: Sequence[PlacedCamera],
        grid: int,
        sizes: Mapping[str, tuple[int, int]],
        base_frame: bool,
        unit: str,
        max_depth: float,
        depth_keys: Mapping[str, str] | None = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        optional: Iterable[str] = (),
        as_points: bool = False,
        augmentation: DepthAugmentation | None = None,
    ) -> None:
        super().__init__()
        self.cameras, self.grid = tuple(camera.name for camera in placed), grid
        self.placed = {camera.name: camera for camera in placed}
        for camera in placed:
            camera.check_view()
        self.bounds, self.optional = dict(bounds or {}), frozenset(optional)
        self.feature_dim, self.points = depth_features(as_points)
        self.sizes, self.base_frame, self.unit, self.max_depth = dict(sizes), base_frame, unit, max_depth
        self.depth_keys = dict(depth_keys or {})
        self.augmentation = augmentation or DepthAugmentation()

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return [
            camera
            for camera in self.cameras
            if find_depth_key(camera, batch, self.depth_keys) is None or not self._has_pose(camera, batch)
        ]

    def may_lack(self, camera: str, batch: Mapping[str, Tensor]) -> bool:
        """An optional camera may be away; depth without the pose that it needs is an error of the data."""
        return camera in self.optional and find_depth_key(camera, batch, self.depth_keys) is None

    def missing_message(self, cameras: list[str]) -> str:
        keys = ", ".join(self._expected_key(camera) for camera in cameras)
        on_arm = [camera for camera in cameras if self.base_frame and self.placed[camera].on_arm]
        if on_arm:
            need = (
                f", and {RAW_STATE} for {', '.join(on_arm)}, whose pose follows from the joints (processors of new "
                f"checkpoints copy "
                "it; make this checkpoint's anew if they do not)"
            )
        else:
            poses = ", ".join(extrinsics_key(camera) for camera in cameras)
            need = f" (and, for a camera without extrinsics in its calibration, {poses})"
        return (
            f"The observation has no depth from camera(s) {', '.join(cameras)}: expected {keys}{need}; connect the depth camera, "
            "give its key this name (in training, leave depth out of --rename_map), name it in "
            "--policy.optional_depth_cameras if it may be missing, or train with "
            "--policy.geometry_source=none."
        )

    def _expected_key(self, camera: str) -> str:
        return self.depth_keys.get(camera, depth_key(camera))

    def _has_pose(self, camera: str, batch: Mapping[str, Tensor]) -> bool:
        if not self.base_frame or extrinsics_key(camera) in batch:
            return True
        placed = self.placed[camera]
        return placed.placed and (not placed.on_arm or RAW_STATE in batch)

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        missing = self.missing_cameras(batch)
        present = [camera for camera in self.cameras if camera not in missing]
        if not present:
            raise ValueError(f"No depth in the batch; expected {', '.join(map(self._expected_key, self.cameras))}.")
        measured = {camera: self._camera(camera, batch, check) for camera in present}
        like = measured[present[0]]
        absent = GeometryFeatures(torch.zeros_like(like.features), torch.zeros_like(like.valid))
        views = [measured.get(camera, absent) for camera in self.cameras]
        return GeometryFeatures(
            torch.stack([view.features for view in views], dim=1), torch.stack([view.valid for view in views], dim=1)
        )

    def _camera(self, camera: str, batch: Mapping[str, Tensor], check: bool) -> GeometryFeatures:
        """Features (B, G, C) and validity (B, G) of one camera."""
        key = find_depth_key(camera, batch, self.depth_keys)
        assert key is not None
        raw, placed, bounds = batch[key], self.placed[camera], self.bounds.get(camera, (0.0, math.inf))
        rows = placed.rows(batch)
        factor = placed.depth_factor(rows, raw.device)
        depth, valid = to_metres(raw, key, self.unit, self.sizes[camera], self.max_depth, factor, bounds)
        if check:
            placed.check_rigs(batch)
            check_unit(raw, key, self.unit, factor, bounds)
            if self.training and camera not in self.optional:
                check_measured(raw, key)
        drawn = batch[AUGMENTATION_KEY].to(raw.device) if self.training and AUGMENTATION_KEY in batch else None
        number = self.cameras.index(camera)
        if drawn is not None:
            depth, valid = augment_depth(self.augmentation, depth, valid, drawn, number, self.max_depth)
        intrinsics, pose = placed.intrinsics(rows, depth.device), None
        if self.base_frame:
            pose = self._pose(camera, batch, rows, depth.device, check)
            if drawn is not None:
                pose = jittered(self.augmentation, pose, drawn, number)
            known = pose.isfinite().flatten(-2).all(dim=-1)  # with a pose of NaN no point is known
            valid = valid & known.reshape(-1, 1, 1, 1)
        points = placed_points(depth, intrinsics, pose)
        return cell_points(points, valid, self.grid) if self.points else cell_statistics(points, valid, self.grid)

    def _pose(
        self, camera: str, batch: Mapping[str, Tensor], rows: Tensor | None, device: torch.device, check: bool
    ) -> Tensor:
        """`base_T_camera`, (B, 4, 4) or (4, 4): from the batch, or from the calibration."""
        key = extrinsics_key(camera)
        if key not in batch:
            return self.placed[camera].poses(batch, rows, device)
        pose = as_pose(batch[key], key)
        if check:
            check_rigid(pose, key)
        return self.placed[camera].frame_poses(pose, rows)


def depth_features(as_points: bool) -> tuple[int, int]:
    """Length of a cell's features, and how many points they are (0: statistics)."""
    return (4 * SAMPLES**2, SAMPLES**2) if as_points else (FEATURE_DIM, 0)


def cell_points(points: Tensor, valid: Tensor, grid: int) -> GeometryFeatures:
    """Sample SAMPLES x SAMPLES points of each of grid x grid cells from a point map (B, 3, H, W) with validity (B, 1, H, W).

    Pixels are taken at the centres of equal parts of a cell. Returns features (B, grid², 4 SAMPLES²): x, y, z and 1 for each
    point, or four zeros where it was not measured; and validity (B, grid²), False for a cell without any.
    """
    side = grid * SAMPLES
    known = torch.cat([points.masked_fill(~valid, 0.0), valid.to(points.dtype)], dim=1)  # (B, 4, H, W)
    sampled = F.interpolate(known, size=(side, side), mode="nearest-exact")
    cells = sampled.unflatten(3, (grid, SAMPLES)).unflatten(2, (grid, SAMPLES))  # (B, 4, g, s, g, s)
    cells = cells.permute(0, 2, 4, 3, 5, 1).flatten(3, 4).flatten(1, 2)  # (B, G, s², 4)
    return GeometryFeatures(cells.flatten(2), (cells[..., 3] > 0).any(dim=-1))


def cell_statistics(points: Tensor, valid: Tensor, grid: int) -> GeometryFeatures:
    """Pool a point map (B, 3, H, W) with validity (B, 1, H, W) to grid x grid cells.

    Returns features (B, grid², C), zeros where a cell has no valid pixel, and validity (B, grid²).
    """
    points = points.masked_fill(~valid, 0.0)
    fraction = _cell_means(valid.to(points.dtype), grid)  # (B, 1, g, g)
    share = fraction.clamp_min(torch.finfo(points.dtype).tiny)
    mean = _cell_means(points, grid) / share
    square = _cell_means(points.square_(), grid) / share
    spread = (square - mean.square()).clamp_min(0.0).sqrt()
    angles = torch.cat([mean * (2 * torch.pi / wavelength) for wavelength in WAVELENGTHS], dim=1)
    features = torch.cat([mean, spread, fraction, angles.sin(), angles.cos()], dim=1)
    seen = (fraction > 0).flatten(2)  # (B, 1, G)
    return GeometryFeatures(features.flatten(2).masked_fill(~seen, 0.0).mT, seen[:, 0])


def _cell_means(values: Tensor, grid: int) -> Tensor:
    """Means over grid x grid cells, (B, C, H, W) -> (B, C, grid, grid): of rows first where all have one size."""
    if values.shape[-1] % grid or values.shape[-2] % grid:
        return F.adaptive_avg_pool2d(values, grid)
    return values.unflatten(-1, (grid, -1)).mean(dim=-1).unflatten(-2, (grid, -1)).mean(dim=-2)
