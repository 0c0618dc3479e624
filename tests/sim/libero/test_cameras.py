"""The moved camera, and depth, intrinsics and extrinsics of a MuJoCo camera, without LIBERO."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_policy_pi05_geometry.sim.libero.cameras import (
    CAMERA_RANGES,
    CameraMove,
    find_range,
    mujoco_quaternion,
    opencv_pose,
)

PIVOT = np.array([0.0, 0.0, 0.9])


def stock_pose() -> np.ndarray:
    """LIBERO's front camera on its table scene (libero_tabletop_manipulation.py)."""
    quaternion = [0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349]
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return opencv_pose(np.array([0.6586131746834771, 0.0, 1.6103500240372423]), rotation)


def drawn_moves():
    generator = np.random.default_rng(0)
    return [(name, chosen.draw(generator)) for name, chosen in CAMERA_RANGES.items() for _ in range(10)]


@pytest.mark.parametrize(("name", "move"), drawn_moves())
def test_a_moved_camera_is_rigid_and_at_the_distance_that_was_asked_for(name, move):
    pose = move.apply(stock_pose(), PIVOT)
    assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) > 0
    assert np.allclose(pose[3], [0, 0, 0, 1])
    distance = np.linalg.norm(pose[:3, 3] - PIVOT) / np.linalg.norm(stock_pose()[:3, 3] - PIVOT)
    assert distance == pytest.approx(move.distance)


def test_the_fixed_range_is_the_stock_camera():
    move = find_range("fixed").draw(np.random.default_rng(1))
    assert np.allclose(move.apply(stock_pose(), PIVOT), stock_pose())


def test_each_part_of_a_move_does_what_its_name_says():
    start = stock_pose()
    right, down, forward = start[:3, 0], start[:3, 1], start[:3, 2]
    around = CameraMove(azimuth=90.0).apply(start, PIVOT)
    assert np.allclose(around[:3, 3], [-start[1, 3], start[0, 3], start[2, 3]])  # a quarter turn, seen from above
    assert CameraMove(lift=10.0).apply(start, PIVOT)[2, 3] > start[2, 3] + 0.05
    turned = CameraMove(turn=10.0).apply(start, PIVOT)
    assert np.allclose(turned[:3, 3], start[:3, 3])
    assert turned[:3, 2] @ right > 0.1
    tilted = CameraMove(tilt=10.0).apply(start, PIVOT)
    assert abs(tilted[:3, 2] @ down) > 0.1
    assert tilted[:3, 2] @ right == pytest.approx(0, abs=1e-9)
    assert forward @ tilted[:3, 2] == pytest.approx(np.cos(np.radians(10)))


@pytest.mark.parametrize("name", list(CAMERA_RANGES))
def test_what_the_stock_camera_looks_at_stays_in_the_image(name):
    generator = np.random.default_rng(2)
    tangent = np.tan(np.radians(45) / 2)  # of LIBERO's field of view
    for _ in range(200):
        pose = find_range(name).draw(generator).apply(stock_pose(), PIVOT)
        x, y, z = pose[:3, :3].T @ (PIVOT - pose[:3, 3])
        assert z > 0
        assert max(abs(x / z), abs(y / z)) < tangent


def test_training_and_outside_ranges_do_not_overlap():
    generator = np.random.default_rng(3)
    outside = [abs(find_range("outside").draw(generator).azimuth) for _ in range(200)]
    inside = [abs(find_range("train").draw(generator).azimuth) for _ in range(200)]
    assert min(outside) > max(inside) + 4
    assert {np.sign(find_range("outside").draw(generator).azimuth) for _ in range(50)} == {-1, 1}


def test_a_pose_survives_mujocos_quaternion():
    pose = CameraMove(30, 5, 1.2, 4, -3).apply(stock_pose(), PIVOT)
    rotation = Rotation.from_quat(mujoco_quaternion(pose), scalar_first=True).as_matrix()
    assert np.allclose(opencv_pose(pose[:3, 3], rotation), pose)


def test_an_unknown_range_is_refused_with_the_names():
    with pytest.raises(ValueError, match="fixed, train, outside, plus"):
        find_range("far")


# --- a MuJoCo scene with LIBERO's names -----------------------------------------------------------------------------

SCENE = """
<mujoco><visual><global offwidth="64" offheight="64"/></visual><worldbody>
  <light pos="0 0 3"/>
  <geom type="plane" size="3 3 .1" group="1"/>
  <body name="robot0_base" pos="-.6 .1 .2"/>
  <geom type="box" size=".1 .05 .08" pos=".1 .15 .08" euler="0 0 25" group="1"/>
  <geom type="sphere" size=".09" pos="-.15 -.1 .09" group="1"/>
  <geom type="box" size=".4 .4 .6" group="0"/>
  <camera name="agentview" pos=".66 0 .71" quat=".68 .20 .35 .60" fovy="45"/>
  <body name="arm" pos="0 0 .5"><joint name="swing" type="hinge" axis="0 1 0"/>
    <geom type="box" size=".01 .01 .01" group="1"/>
    <camera name="robot0_eye_in_hand" pos=".05 0 -.02" euler="10 -10 0" fovy="75"/></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def rigged():
    from lerobot_policy_pi05_geometry.sim.headless import mujoco
    from lerobot_policy_pi05_geometry.sim.libero.rendering import CameraRig

    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rig = CameraRig(model, 64, "fast")
    yield mujoco, model, data, rig
    rig.close()


@pytest.mark.sim
@pytest.mark.parametrize("camera", ["front", "wrist"])
@pytest.mark.parametrize("swing", [0.0, 0.3])
def test_depth_is_what_rays_meet_and_wrong_images_and_wrong_calibrations_are_found_out(rigged, camera, swing):
    from lerobot_policy_pi05_geometry.sim.libero.rendering import ray_errors

    mujoco, _, data, rig = rigged
    data.joint("swing").qpos[0] = swing
    mujoco.mj_forward(rig.model, data)
    frame = rig.take(data, camera)
    right = ray_errors(rig, data, camera, frame, 400)
    assert len(right) > 200
    assert np.median(right) < 1e-4
    assert np.quantile(right, 0.9) < 5e-4

    mirrored = dataclasses.replace(frame, depth=frame.depth[:, ::-1])
    assert np.quantile(ray_errors(rig, data, camera, mirrored, 400), 0.9) > 5e-3
    upside_down = dataclasses.replace(frame, depth=frame.depth[::-1])
    assert np.quantile(ray_errors(rig, data, camera, upside_down, 400), 0.9) > 5e-3
    own = rig.calibration[camera]
    for axis in (2, 3):
        intrinsics = list(own.intrinsics)
        intrinsics[axis] += 0.5
        rig.calibration[camera] = dataclasses.replace(own, intrinsics=intrinsics)
        wrong = ray_errors(rig, data, camera, frame, 400)
        rig.calibration[camera] = own
        assert np.median(wrong) > 1e-4


@pytest.mark.sim
def test_without_depth_it_is_zero_and_the_picture_is_the_same(rigged):
    from lerobot_policy_pi05_geometry.sim.libero.rendering import CameraRig

    _, model, data, rig = rigged
    blind = CameraRig(model, 64, "fast", depth=False)
    try:
        frame = blind.take(data, "front")
        assert not frame.depth.any()
        assert np.array_equal(frame.pixels, rig.take(data, "front").pixels)
    finally:
        blind.close()
