"""Camera rays: they meet the points that depth measures, and say nothing else."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.calibration import Rig
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration, Mount
from lerobot_policy_pi05_geometry.geometry.keys import RAW_STATE, RIG, extrinsics_key
from lerobot_policy_pi05_geometry.geometry.kinematics import ForwardKinematics
from lerobot_policy_pi05_geometry.geometry.placed_camera import PlacedCamera
from lerobot_policy_pi05_geometry.geometry.point_map import transform, unproject
from lerobot_policy_pi05_geometry.geometry.rays import RaySource
from tests.entry_points import make_batch, make_calibration, make_policy
from tests.geometry.arms import random_state, so101_like
from tests.geometry.scenes import generator, random_pose, seeds, uniform

INTRINSICS, SIZE = [40.0, 44.0, 30.0, 24.0], [63, 49]  # width and height are odd multiples of the grid
ORIGIN, DIRECTION = slice(0, 3), slice(3, 6)


def source(grid: int = 7, extrinsics=None, scale: int = 1) -> RaySource:
    camera = CameraCalibration(INTRINSICS, SIZE, extrinsics)
    return of_rigs({0: Rig({"front": camera})}, grid, scale)


def of_rigs(rigs: dict[int, Rig], grid: int = 7, scale: int = 1, only: int | None = None) -> RaySource:
    size = (SIZE[1] * scale, SIZE[0] * scale)
    return RaySource([PlacedCamera("front", rigs, size, only)], grid, {"front": size})


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


@given(seed=seeds)
def test_rays_of_a_camera_on_an_arm_and_of_several_rigs_are_those_of_its_pose(seed):
    """Each row is seen by its own rig's intrinsics and pose, which follows from the joints where the camera is on an arm."""
    random, arm = generator(seed), so101_like()
    mount = Mount("arm", "gripper", random_pose(random, 0.1).tolist())
    on_arm = Rig({"front": CameraCalibration(INTRINSICS, SIZE, mount=mount)}, {"arm": arm})
    fixed = Rig({"front": CameraCalibration([50.0, 50.0, 31.0, 20.0], SIZE, random_pose(random).tolist())})
    ids = [7, 2, 7]
    state = random_state(random, arm, 3, width=6)
    observation = {"observation.state": torch.zeros(3, 6), RAW_STATE: state, RIG: torch.tensor(ids)[:, None]}
    found = of_rigs({2: on_arm, 7: fixed})(observation)
    link = ForwardKinematics(arm, ["gripper"])(state[1:2].double())[0, 0]
    pose = link @ torch.tensor(mount.link_T_camera, dtype=torch.float64)
    as_fixed = Rig({"front": replace(on_arm.cameras["front"], mount=None, extrinsics=pose.tolist())})
    for row, rig in enumerate((fixed, as_fixed, fixed)):
        alone = {key: value[row : row + 1] for key, value in observation.items() if key != RIG}
        expected = of_rigs({0: rig})(alone).features
        assert (found.features[row : row + 1, ..., :6] - expected[..., :6]).abs().max() < 1e-5
        chosen = of_rigs({2: on_arm, 7: fixed}, only=ids[row])(alone).features
        assert torch.equal(chosen, found.features[row : row + 1])


def test_a_camera_on_an_arm_needs_the_raw_state_and_rigs_their_number():
    mount = Mount("arm", "gripper", torch.eye(4).tolist())
    on_arm = Rig({"front": CameraCalibration(INTRINSICS, SIZE, mount=mount)}, {"arm": so101_like()})
    rays, observation = of_rigs({0: on_arm}), {"observation.state": torch.zeros(1, 6)}
    assert rays.missing_cameras(observation) == ["front"]
    assert RAW_STATE in rays.missing_message(["front"])
    assert rays.missing_cameras(observation | {RAW_STATE: torch.zeros(1, 6)}) == []
    both = of_rigs({0: on_arm, 1: on_arm})
    with pytest.raises(ValueError, match=r"several rigs \(0, 1\).*--policy.rig"):
        both(observation | {RAW_STATE: torch.zeros(1, 6)})
    with pytest.raises(ValueError, match="rig has 4, but the calibration has the rigs 0, 1"):
        both(observation | {RAW_STATE: torch.zeros(1, 6), RIG: torch.tensor([4])})


@pytest.mark.parametrize("data", ["mount", "rigs"])
def test_a_policy_with_rays_takes_mounts_and_rigs(data):
    """Its checkpoint carries arms and rigs, as with depth, and every row follows its own rig."""
    batch = make_batch(2) | {RAW_STATE: torch.rand(2, 6)}
    cameras = make_calibration()
    mounted = {
        **cameras,
        "front": replace(cameras["front"], extrinsics=None, mount=Mount("arm", "gripper", torch.eye(4).tolist())),
    }
    arms = {"arm": so101_like()}
    if data == "mount":
        policy = make_policy(geometry_source="rays", calibration=mounted, arms=arms)
    else:
        rigs = {"0": Rig(cameras), "1": Rig(mounted, arms)}
        policy = make_policy(geometry_source="rays", calibration={}, rigs=rigs)
        batch[RIG] = torch.tensor([1, 0])
    features = policy.geometry.source(batch).features[:, 0, 0, :3]
    link = ForwardKinematics(arms["arm"], ["gripper"])(batch[RAW_STATE][:1])[0, 0]
    assert (features[0] - link[:3, 3]).abs().max() < 1e-5
    if data == "rigs":
        assert (features[1] - torch.tensor(cameras["front"].extrinsics)[:3, 3]).abs().max() < 1e-5
    policy.train().forward(batch)[0].backward()
