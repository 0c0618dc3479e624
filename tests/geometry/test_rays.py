"""Camera rays: they meet the points that depth measures, and say nothing else."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.keys import extrinsics_key
from lerobot_policy_pi05_geometry.geometry.point_map import transform, unproject
from lerobot_policy_pi05_geometry.geometry.rays import RaySource
from tests.geometry.scenes import generator, random_pose, seeds, uniform

INTRINSICS, SIZE = [40.0, 44.0, 30.0, 24.0], [63, 49]  # width and height are odd multiples of the grid
ORIGIN, DIRECTION = slice(0, 3), slice(3, 6)


def source(grid: int = 7, extrinsics=None, scale: int = 1) -> RaySource:
    camera = CameraCalibration(INTRINSICS, SIZE, extrinsics)
    return RaySource(("front",), grid, {"front": camera}, {"front": (SIZE[1] * scale, SIZE[0] * scale)})


def batch(pose: torch.Tensor) -> dict[str, torch.Tensor]:
    return {extrinsics_key("front"): pose, "observation.state": torch.zeros(len(pose), 2)}


@given(seed=seeds, scale=st.sampled_from([1, 3]))
def test_a_ray_meets_the_point_that_its_cells_centre_measures(seed, scale):
    """The middle pixel of a cell, moved to the base frame with its depth, lies on the ray: at every depth."""
    random = generator(seed)
    pose = torch.stack([random_pose(random), random_pose(random)]).float()
    height, width, grid = SIZE[1] * scale, SIZE[0] * scale, 7
    features, valid = source(grid, scale=scale)(batch(pose))
    assert features.shape[:3] == valid.shape == (2, 1, grid**2)
    assert valid.all()
    depth = uniform(random, 0.2, 3.0, 2, 1, height, width)
    intrinsics = torch.tensor(CameraCalibration(INTRINSICS, SIZE).scaled_intrinsics(height, width))
    points = transform(pose, unproject(depth, intrinsics))  # (2, 3, H, W)
    rows = torch.arange(grid) * (height // grid) + height // grid // 2
    columns = torch.arange(grid) * (width // grid) + width // grid // 2
    measured = points[:, :, rows][..., columns].flatten(2).mT  # (2, G, 3)
    origin, direction = features[:, 0, :, ORIGIN], features[:, 0, :, DIRECTION]
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(2, grid**2))
    along = ((measured - origin) * direction).sum(dim=-1, keepdim=True)
    assert (along > 0).all()
    torch.testing.assert_close(origin + along * direction, measured, atol=1e-4, rtol=0)


@given(seed=seeds)
def test_depth_and_images_change_nothing(seed):
    random = generator(seed)
    observation = batch(random_pose(random)[None].float())
    plain = source()(observation)
    more = {
        **observation,
        "observation.images.front": torch.rand(1, 3, 49, 63, generator=random),
        "observation.images.front_depth": torch.rand(1, 1, 49, 63, generator=random),
    }
    assert torch.equal(source()(more).features, plain.features)


def test_a_pose_of_the_calibration_equals_the_same_pose_in_the_observation():
    pose = random_pose(generator(3)).float()
    observation = batch(pose[None])
    fixed = {"observation.state": observation["observation.state"]}
    fixed_source = source(extrinsics=pose.tolist())
    assert fixed_source.missing_cameras(fixed) == []
    assert torch.equal(fixed_source(fixed).features, source()(observation).features)


def test_a_camera_without_a_pose_is_missing_and_its_cells_are_masked():
    rays = source()
    assert rays.missing_cameras({"observation.state": torch.zeros(1, 2)}) == ["front"]
    assert "observation.calibration.front.extrinsics" in rays.missing_message(["front"])
    features, valid = rays({"observation.state": torch.zeros(1, 2)})
    assert not valid.any()
    assert not features.any()


def test_a_pose_that_is_not_rigid_is_refused():
    with pytest.raises(ValueError, match="must be a rigid transform"):
        source()(batch(2 * torch.eye(4)[None]))
