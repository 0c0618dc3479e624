"""LIBERO itself: needs the extra `libero` (docs/libero.md). Run with `-m libero -n 0`."""

import json

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import preprocess_observation

from lerobot_policy_pi05_geometry.geometry.dataset_calibration import read_dataset_calibration
from lerobot_policy_pi05_geometry.geometry.point_map import transform, unproject
from lerobot_policy_pi05_geometry.sim.libero.cameras import CameraMove

pytestmark = pytest.mark.libero

SIZE = 96
TASK = ("libero_spatial", 2)


@pytest.fixture(scope="module")
def environment():
    from lerobot_policy_pi05_geometry.sim.libero.environment import RgbdLiberoEnv

    built = RgbdLiberoEnv(*TASK, cameras="plus", placement="near", image_size=SIZE, rendering="fast")
    built.reset(seed=0)  # robosuite's controller: the first episode of a process differs from its repetitions by 0.2 mm
    yield built
    built.close()


def points_of(scene, name: str) -> np.ndarray:
    """Points of a camera's frame in the base frame, (3, H, W) metres."""
    frame = scene.frames[name]
    depth = torch.from_numpy(frame.depth)[None, None].double()
    intrinsics = torch.tensor(scene.rig.calibration[name].intrinsics, dtype=torch.float64)
    return transform(torch.from_numpy(frame.extrinsics), unproject(depth, intrinsics))[0].numpy()


def observed_now(scene) -> None:
    """Take the frames of the simulation as it is, so that ray casting sees the same moment."""
    scene.env.sim.forward()
    scene.frames = {name: scene.rig.take(scene.data, name) for name in ("front", "wrist")}


# --- geometry -------------------------------------------------------------------------------------------------------


def test_depth_is_what_rays_meet_in_motion_too_and_a_mirrored_one_is_not(environment):
    import dataclasses

    from lerobot_policy_pi05_geometry.sim.libero.rendering import ray_errors

    environment.reset(seed=1)
    scene = environment.scene
    for step in range(6):
        environment.step(np.array([0.8, 0.5, -0.6, 0.2, -0.2, 0.4, -1.0]))
        if step % 3:
            continue
        observed_now(scene)
        for name, frame in scene.frames.items():
            errors = ray_errors(scene.rig, scene.data, name, frame, 200)
            assert len(errors) > 100
            assert np.median(errors) < 1e-4
            assert np.quantile(errors, 0.9) < 5e-4
            mirrored = dataclasses.replace(frame, depth=frame.depth[:, ::-1])
            assert np.quantile(ray_errors(scene.rig, scene.data, name, mirrored, 200), 0.9) > 5e-3


def test_pose_and_image_are_of_one_moment(environment):
    """While the wrist moves, the observed frame's pose is the camera's at the time of the picture, not after `step`."""
    environment.reset(seed=2)
    scene = environment.scene
    taken: list = []
    original = scene.rig.take

    def take(data, name):
        frame = original(data, name)
        taken.append((name, np.array(data.cam_xpos[scene.rig._id(name)]), frame.extrinsics))
        return frame

    scene.rig.take = take
    try:
        for _ in range(4):
            observation = environment.step(np.array([1.0, 0, 0, 0, 0, 0, -1.0]))[0]
    finally:
        scene.rig.take = original
    name, position, extrinsics = taken[-1]
    assert name == "wrist"
    assert np.allclose(extrinsics[:3, 3] + scene.base, position)
    assert np.allclose(observation["calibration.wrist.extrinsics"], extrinsics, atol=1e-6)
    scene.env.sim.forward()
    assert np.linalg.norm(scene.data.cam_xpos[scene.rig._id("wrist")] - position) > 1e-5


@pytest.mark.parametrize("seed", [0, 5])
def test_the_table_is_a_plane_at_its_own_height(environment, seed):
    environment.reset(seed=seed)
    scene = environment.scene
    observed_now(scene)
    surface = 0.9 - scene.base[2]
    for name in ("front", "wrist"):
        height = points_of(scene, name)[2]
        assert (np.abs(height - surface) < 0.001).mean() > 0.05


def test_both_cameras_see_the_plate_in_one_place(environment):
    environment.reset(seed=3)
    scene = environment.scene
    scene.move_camera(CameraMove())
    plate = scene.model.body("plate_1_main").id
    centre = scene.data.xpos[plate] - scene.base
    # Above the plate, so that the wrist camera sees it.
    for _ in range(60):
        error = centre + np.array([0.0, 0.0, 0.25]) - (scene.data.site("gripper0_grip_site").xpos - scene.base)
        environment.step(np.array([*np.clip(error / 0.05, -1, 1), 0, 0, 0, -1.0]))
    observed_now(scene)
    clouds = []
    for name in ("front", "wrist"):
        points = points_of(scene, name).reshape(3, -1).T
        near = np.linalg.norm(points[:, :2] - centre[:2], axis=1) < 0.06
        clouds.append(points[near & (np.abs(points[:, 2] - centre[2]) < 0.05)])
        assert len(clouds[-1]) > 30
    distances = np.linalg.norm(clouds[0][:, None] - clouds[1][None], axis=-1)
    assert np.median(distances.min(axis=0)) < 0.008  # pixels are 8 mm apart at this size
    heights = [np.median(cloud[:, 2]) for cloud in clouds]
    assert abs(heights[0] - heights[1]) < 0.003


# --- the environment ------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_episode_and_another_one_another(environment):
    one = environment.reset(seed=7)[0]
    again = environment.reset(seed=7)[0]
    other = environment.reset(seed=8)[0]
    assert np.array_equal(one["images.front_depth"], again["images.front_depth"])
    assert np.array_equal(one["agent_pos"], again["agent_pos"])
    assert not np.array_equal(one["calibration.front.extrinsics"], other["calibration.front.extrinsics"])
    assert environment.observation_space.contains(one)


def test_objects_placed_anew_touch_nothing_and_differ_between_seeds(environment):
    from lerobot_policy_pi05_geometry.sim.libero.placement import GAP, movable, rectangles

    scene = environment.scene or environment._started()
    places = []
    for seed in range(4):
        environment.reset(seed=seed)
        boxes = rectangles(scene)
        for name in movable(scene):
            for other, box in boxes.items():
                apart = np.maximum(boxes[name][0] - box[1], box[0] - boxes[name][1])
                assert other == name or apart.max() > GAP - 0.012
        places.append(boxes["akita_black_bowl_1"].mean(axis=0)[:2])
    assert np.ptp(np.stack(places), axis=0).max() > 0.03


def test_objects_that_hang_above_the_floor_in_the_initial_states_can_be_placed_anew():
    """As LIBERO-Object's do, by up to 4 cm: falling is no sliding."""
    from lerobot_policy_pi05_geometry.sim.libero.scene import LiberoScene
    from lerobot_policy_pi05_geometry.sim.libero.tasks import find_task

    scene = LiberoScene(find_task("libero_object", 0), cameras=())
    places = []
    try:
        for seed in range(3):
            scene.reset(seed, "near")
            body = scene.model.body(scene.env.objects_dict["alphabet_soup_1"].root_body).id
            places.append(np.array(scene.data.xpos[body]))
            for _ in range(3):
                scene.step(np.array([0, 0, 0, 0, 0, 0, -1.0]))
            assert np.linalg.norm(scene.data.xpos[body] - places[-1]) < 0.002  # it is at rest
    finally:
        scene.close()
    assert np.ptp(np.stack(places)[:, :2], axis=0).max() > 0.03


def test_an_initial_state_without_room_gives_way_to_the_next(environment):
    """In this seed's own state, number 20, the plate stands between what stays: no place was found in 2,000 tries."""
    environment.reset(seed=1_000_020)
    assert environment.scene.frames


def test_rgb_in_full_rendering_is_lerobots():
    from lerobot.envs.configs import LiberoEnv as LeRobotConfig
    from lerobot.processor import PolicyProcessorPipeline  # noqa: F401  (the steps that LeRobot's config builds)

    from lerobot_policy_pi05_geometry.sim.libero.environment import RgbdLiberoEnv

    ours = RgbdLiberoEnv(*TASK, image_size=128, state_frame="world")
    config = LeRobotConfig(task=TASK[0], task_ids=[TASK[1]], observation_height=128, observation_width=128)
    theirs = config.create_envs(1)[TASK[0]][TASK[1]]
    try:
        observation, _ = ours.reset(seed=0)
        batch = preprocess_observation(theirs.reset(seed=[0])[0])
        batch = config.get_env_processors()[0].process_observation(batch)
        assert np.allclose(observation["agent_pos"], batch["observation.state"][0].numpy(), atol=2e-3)
        for mine, other in (("front", "image"), ("wrist", "image2")):
            expected = batch[f"observation.images.{other}"][0].permute(1, 2, 0).numpy() * 255
            error = np.abs(observation["pixels"][mine].astype(float) - expected)
            assert np.median(error) <= 1
            assert error.mean() < 3
            assert np.abs(observation["pixels"][mine][:, ::-1].astype(float) - expected).mean() > 3 * error.mean()
    finally:
        ours.close()
        theirs.close()


# --- data -----------------------------------------------------------------------------------------------------------


def test_an_expert_episode_is_recorded_with_depth_poses_and_calibration(environment, tmp_path):
    from lerobot_policy_pi05_geometry.sim.libero.environment import RgbdLiberoEnv
    from lerobot_policy_pi05_geometry.sim.libero.record import record

    other = RgbdLiberoEnv(*TASK, "train", image_size=84, rendering="fast")
    root = tmp_path / "data"
    assert list(record(root, "local/data", [other], 1))[-1] == (1, True)
    dataset = LeRobotDataset("local/data", root=root)
    item = dataset[5]
    assert item["observation.images.front_depth"].shape[-2:] == (84, 84)
    assert item["observation.calibration.wrist.extrinsics"].shape == (16,)
    assert item["task"] == other.task_description
    calibration = read_dataset_calibration(dataset.meta, {}).cameras
    assert set(calibration) == {"front", "wrist"}
    assert calibration["front"].extrinsics is None
    assert json.loads((root / "meta" / "info.json").read_text())["robot_type"] == "libero_panda"
    # The wrist's recorded depth and pose put the table where it is.
    pose = item["observation.calibration.wrist.extrinsics"].reshape(4, 4).double()
    depth = item["observation.images.wrist_depth"].double().reshape(1, 1, 84, 84) / 1000
    height = transform(pose, unproject(depth, torch.tensor(calibration["wrist"].intrinsics)))[0, 2].numpy()
    assert (np.abs(height - (0.9 - 0.912)) < 0.004).mean() > 0.02
