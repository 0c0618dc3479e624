"""Pinhole cameras: points, poses, and what is no usable calibration."""

import math

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.point_map import placed_points, transform, unproject
from lerobot_policy_pi05_geometry.geometry.rigid import check_rigid
from tests.geometry.scenes import calibrated, generator, project, random_pose, seeds, uniform

sides = st.integers(2, 12)


@given(seed=seeds, height=sides, width=sides)
def test_projecting_points_back_gives_the_pixels(seed, height, width):
    random = generator(seed)
    camera, pose = calibrated(height, width, focal=float(uniform(random, 0.5, 2.0, 1))), random_pose(random)
    depth = uniform(random, 0.2, 4.0, 1, 1, height, width).double()
    points = transform(pose, unproject(depth, torch.tensor(camera.intrinsics)))
    pixels, distance = project(points[0].flatten(1).T, pose, camera)
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    torch.testing.assert_close(pixels, torch.stack([u.flatten(), v.flatten()], dim=1), atol=1e-4, rtol=0)
    torch.testing.assert_close(distance, depth.flatten())


@given(seed=seeds)
def test_intrinsics_and_poses_may_differ_within_a_batch(seed):
    random = generator(seed)
    depth = uniform(random, 0.2, 4.0, 2, 1, 5, 6)
    intrinsics = uniform(random, 3.0, 9.0, 2, 4)
    poses = torch.stack([random_pose(random), random_pose(random)])
    together = transform(poses, unproject(depth, intrinsics))
    for row in range(2):
        alone = transform(poses[row], unproject(depth[row : row + 1], intrinsics[row]))
        torch.testing.assert_close(together[row : row + 1], alone)


@given(seed=seeds, same_intrinsics=st.booleans(), same_pose=st.booleans())
def test_points_in_one_pass_are_those_in_two(seed, same_intrinsics, same_pose):
    """In the camera frame too; where all rows share a camera, and where each has its own."""
    random = generator(seed)
    depth = uniform(random, 0.2, 4.0, 2, 1, 5, 6)
    intrinsics = uniform(random, 3.0, 9.0, 2, 4)
    poses = torch.stack([random_pose(random), random_pose(random)])
    intrinsics, poses = intrinsics[0] if same_intrinsics else intrinsics, poses[0] if same_pose else poses
    camera = unproject(depth, intrinsics)
    torch.testing.assert_close(placed_points(depth, intrinsics, None), camera)
    torch.testing.assert_close(placed_points(depth, intrinsics, poses), transform(poses, camera), atol=1e-5, rtol=1e-5)


@given(seed=seeds)
def test_transforms_invert_compose_and_keep_distances(seed):
    random = generator(seed)
    points = uniform(random, -2.0, 2.0, 1, 3, 4, 5).double()
    a, b = random_pose(random), random_pose(random)
    torch.testing.assert_close(transform(torch.linalg.inv(a), transform(a, points)), points)
    torch.testing.assert_close(transform(a, transform(b, points)), transform(a @ b, points))
    flat, moved = points[0].flatten(1).T, transform(a, points)[0].flatten(1).T
    torch.testing.assert_close(torch.cdist(moved, moved), torch.cdist(flat, flat))


@given(seed=seeds, height=sides, width=sides, new_height=sides, new_width=sides)
def test_resizing_leaves_every_ray_where_it_was(seed, height, width, new_height, new_width):
    camera = calibrated(height, width, focal=float(uniform(generator(seed), 0.5, 2.0, 1)))
    fx, fy, cx, cy = camera.intrinsics
    new_fx, new_fy, new_cx, new_cy = camera.scaled_intrinsics(new_height, new_width)
    for u, v in [(0, 0), (width - 1, height - 1), (0.3 * width, 0.8 * height)]:
        # Pixel centres are at integers, so it is u + 0.5 that scales.
        new_u, new_v = (u + 0.5) * new_width / width - 0.5, (v + 0.5) * new_height / height - 0.5
        assert (new_u - new_cx) / new_fx == pytest.approx((u - cx) / fx, abs=1e-9)
        assert (new_v - new_cy) / new_fy == pytest.approx((v - cy) / fy, abs=1e-9)


@pytest.mark.parametrize("factor", [2, 3])
def test_scaled_intrinsics_belong_to_the_pooled_image(factor):
    """The mean of a block of points is the point of the pooled pixel (at constant depth, where this is exact)."""
    camera = calibrated(12, 18)
    fine = unproject(torch.full((1, 1, 12, 18), 1.3), torch.tensor(camera.intrinsics))
    size = (12 // factor, 18 // factor)
    coarse = unproject(torch.full((1, 1, *size), 1.3), torch.tensor(camera.scaled_intrinsics(*size)))
    torch.testing.assert_close(F.avg_pool2d(fine, factor), coarse, atol=1e-6, rtol=1e-6)


def test_intrinsics_hold_at_their_own_size():
    camera = calibrated(12, 18)
    assert camera.scaled_intrinsics(12, 18) == pytest.approx(camera.intrinsics)


@given(seed=seeds)
def test_rigid_poses_pass_in_the_precision_they_come_in(seed):
    pose = random_pose(generator(seed), reach=3.0)
    check_rigid(pose, "pose")
    check_rigid(pose.float(), "pose")
    check_rigid(torch.stack([pose, pose]).float(), "pose")


def broken_poses() -> dict[str, torch.Tensor]:
    """Transforms that are not rigid, one for each way of being so."""
    good = random_pose(generator(0))
    scaled, reflected, no_number, infinite, transposed, sheared = (good.clone() for _ in range(6))
    scaled[:3, :3] *= 1.01
    reflected[:3, 0] *= -1
    no_number[0, 3] = math.nan
    infinite[1, 3] = math.inf
    transposed = transposed.T.contiguous()
    sheared[:3, 1] += 0.01 * sheared[:3, 0]
    return {
        "scaled": scaled,
        "reflected": reflected,
        "NaN": no_number,
        "inf": infinite,
        "transposed": transposed,
        "sheared": sheared,
        "zero": torch.zeros(4, 4),
        "in a batch": torch.stack([good, scaled]),
    }


@pytest.mark.parametrize("kind", broken_poses())
def test_what_is_no_rigid_transform_is_refused(kind):
    with pytest.raises(ValueError, match=r"The pose must be a rigid transform.*base_T_camera"):
        check_rigid(broken_poses()[kind], "The pose")


@pytest.mark.parametrize("shape", [(3, 4), (4, 3), (16,), (2, 16)])
def test_a_pose_that_is_not_4_by_4_is_refused(shape):
    with pytest.raises(ValueError, match=r"must be 4 x 4"):
        check_rigid(torch.zeros(shape), "The pose")


@pytest.mark.parametrize(
    ("intrinsics", "said"),
    [
        ([0.0, 600.0, 320.0, 240.0], "singular"),
        ([600.0, -600.0, 320.0, 240.0], "singular"),
        ([600.0, math.nan, 320.0, 240.0], "four finite numbers"),
        ([600.0, math.inf, 320.0, 240.0], "four finite numbers"),
        ([600.0, 600.0, 320.0], "four finite numbers"),
        ([], "four finite numbers"),
    ],
)
def test_unusable_intrinsics_are_refused(intrinsics, said):
    with pytest.raises(ValueError, match=rf"Intrinsics of camera 'front' .*{said}"):
        CameraCalibration(intrinsics, [640, 480]).check("front")


@pytest.mark.parametrize("size", [[640], [0, 480], [640, -1], [640, 480, 3]])
def test_an_unusable_image_size_is_refused(size):
    with pytest.raises(ValueError, match=r"Size of camera 'front' must be \[width, height\]"):
        CameraCalibration([600.0, 600.0, 320.0, 240.0], size).check("front")


def test_unusable_extrinsics_name_the_camera():
    pose = broken_poses()["scaled"].tolist()
    with pytest.raises(ValueError, match=r"Extrinsics of camera 'front' must be a rigid transform"):
        CameraCalibration([600.0, 600.0, 320.0, 240.0], [640, 480], pose).check("front")
