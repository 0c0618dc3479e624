"""Random cameras and scenes whose geometry is known, for the geometry tests."""

import torch
from hypothesis import strategies as st
from torch import Tensor

from lerobot_policy_pi05_geometry.geometry.calibration import Rig
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.placed_camera import PlacedCamera
from lerobot_policy_pi05_geometry.geometry.rgbd import RgbdSource, depth_key

seeds = st.integers(0, 2**31 - 1)
grids = st.sampled_from([1, 2, 3, 8, 14])


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def uniform(random: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=random)


def random_pose(random: torch.Generator, reach: float = 1.0) -> Tensor:
    """A rigid transform (4, 4) float64: any rotation, and a translation of at most `reach` along each axis."""
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=random, dtype=torch.float64))
    rotation[:, 0] *= torch.linalg.det(rotation).sign()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = uniform(random, -reach, reach, 3)
    return pose


def looking_at(eye: Tensor, target: Tensor) -> Tensor:
    """`base_T_camera` (4, 4) float64 of a camera at `eye` whose optical axis goes through `target`."""
    forward = torch.nn.functional.normalize((target - eye).double(), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]).double()), dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    pose[:3, 3] = eye
    return pose


def camera_above_table(random: torch.Generator) -> Tensor:
    """A camera pose 0.8 to 1.6 m above the base plane, some metres to the side at most, looking at the origin."""
    eye = torch.cat([uniform(random, -1.0, 1.0, 2), uniform(random, 0.8, 1.6, 1)])
    return looking_at(eye, uniform(random, -0.1, 0.1, 3))


def calibrated(height: int, width: int, pose: Tensor | None = None, focal: float = 1.2) -> CameraCalibration:
    """A camera with its optical centre off the middle; focal: in image widths."""
    extrinsics = None if pose is None else pose.tolist()
    return CameraCalibration([focal * width, focal * width, 0.47 * width, 0.52 * height], [width, height], extrinsics)


def project(points: Tensor, pose: Tensor, camera: CameraCalibration) -> tuple[Tensor, Tensor]:
    """Pixels (N, 2) and distance along the optical axis (N,) of points (N, 3) in the base frame."""
    fx, fy, cx, cy = camera.intrinsics
    seen = (points.double() - pose[:3, 3]) @ pose[:3, :3]
    return torch.stack([fx * seen[:, 0] / seen[:, 2] + cx, fy * seen[:, 1] / seen[:, 2] + cy], dim=1), seen[:, 2]


def depth_of_plane(height_of_plane: float, pose: Tensor, camera: CameraCalibration) -> Tensor:
    """Depth (1, 1, H, W) in metres of the horizontal plane at this height in the base frame; 0 where there is none."""
    width, height = camera.size
    fx, fy, cx, cy = camera.intrinsics
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    rays = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u)], dim=-1)  # depth 1 along the optical axis
    depth = (height_of_plane - pose[2, 3]) / (rays @ pose[2, :3])
    return depth.where((depth > 0) & depth.isfinite(), 0.0)[None, None].float()


def make_source(cameras: dict[str, CameraCalibration], grid: int, **changes) -> RgbdSource:
    """An `RgbdSource` in metres and the base frame, for depth of the calibration's own image size."""
    settings = {"base_frame": True, "unit": "m", "max_depth": 10.0} | changes
    sizes = settings.pop("sizes", {name: (camera.size[1], camera.size[0]) for name, camera in cameras.items()})
    arms = settings.pop("arms", {})
    placed = [PlacedCamera(name, {0: Rig(cameras, arms)}, size) for name, size in sizes.items()]
    return RgbdSource(placed, grid, sizes, **settings)


def random_depth(random: torch.Generator, batch: int, height: int, width: int) -> Tensor:
    """Depth (B, 1, H, W) in metres, with a fifth of the pixels not measured."""
    depth = uniform(random, 0.3, 3.0, batch, 1, height, width)
    return depth.where(torch.rand(depth.shape, generator=random) > 0.2, 0.0)


def random_observation(random: torch.Generator, source: RgbdSource, batch: int = 2) -> dict[str, Tensor]:
    """Depth of every camera of a source, and a state."""
    observation = {"observation.state": torch.rand(batch, 4, generator=random)}
    for camera, (height, width) in source.sizes.items():
        observation[depth_key(camera)] = random_depth(random, batch, height, width)
    return observation
