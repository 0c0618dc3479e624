"""The simulated RGB-D robot: what its camera measures is where things are, and its episodes can be recorded."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import preprocess_observation
from lerobot.envs.utils import env_to_policy_features

from lerobot_policy_pi05_geometry.data.quantiles import write_frame_quantiles
from lerobot_policy_pi05_geometry.geometry.dataset_calibration import read_dataset_calibration
from lerobot_policy_pi05_geometry.geometry.point_map import transform, unproject
from lerobot_policy_pi05_geometry.geometry.rigid import check_rigid
from lerobot_policy_pi05_geometry.sim.cameras import CAMERA_RANGES, LOOK_AT
from lerobot_policy_pi05_geometry.sim.configuration import MetaworldRgbdEnv
from lerobot_policy_pi05_geometry.sim.environment import CAMERA, DEPTH_KEY, EXTRINSICS_KEY, RgbdMetaworldEnv
from lerobot_policy_pi05_geometry.sim.headless import mujoco
from lerobot_policy_pi05_geometry.sim.record import FIRST_SEED, record
from lerobot_policy_pi05_geometry.sim.tasks import WIDE_TASKS, find_task, make_expert

pytestmark = pytest.mark.sim

TASK = "button-press-topdown-wide"
SIZE = 64


@pytest.fixture(scope="module")
def environments():
    """Environments of the default task by camera range, built once."""
    built: dict[str, RgbdMetaworldEnv] = {}

    def get(cameras: str = "train") -> RgbdMetaworldEnv:
        if cameras not in built:
            built[cameras] = RgbdMetaworldEnv(TASK, cameras, SIZE)
        return built[cameras]

    yield get
    for environment in built.values():
        environment.close()


def points_of(environment: RgbdMetaworldEnv, observation: dict) -> torch.Tensor:
    """Points (3, H, W) in the base frame, from what the observation and the calibration say."""
    metres = torch.from_numpy(observation[DEPTH_KEY])[None, ..., 0][None] / 1000
    intrinsics = torch.tensor(environment.calibration[CAMERA].intrinsics)
    return transform(torch.from_numpy(observation[EXTRINSICS_KEY]), unproject(metres, intrinsics))[0]


# --- geometry -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cameras", ["train", "outside", "far"])
def test_the_table_top_is_a_plane_at_height_zero_from_every_camera_pose(environments, cameras):
    environment = environments(cameras)
    for seed in range(3):
        observation, _ = environment.reset(seed=seed)
        measured = torch.from_numpy(observation[DEPTH_KEY][..., 0]) > 0
        height = points_of(environment, observation)[2][measured]
        assert (height.abs() < 0.005).float().mean() > 0.2
        # Nothing else is as flat: no other height has as many points.
        counts = torch.histc(height, bins=100, min=-0.505, max=0.495)
        assert counts.argmax() in (50, 51)


@pytest.mark.parametrize("cameras", ["fixed", "wide"])
def test_depth_is_what_a_ray_through_the_pixel_meets(environments, cameras):
    """MuJoCo's ray casting knows nothing of rendering, so it checks intrinsics, extrinsics and depth at once."""
    import mujoco  # after environment.py has chosen headless rendering

    environment = environments(cameras)
    observation, _ = environment.reset(seed=4)
    model, data = environment._simulator.model, environment._simulator.data
    pose, points = observation[EXTRINSICS_KEY].astype(np.float64), points_of(environment, observation).double().numpy()
    generator = np.random.default_rng(0)
    errors = []
    for v, u in generator.integers(0, SIZE, (200, 2)):
        if not observation[DEPTH_KEY][v, u, 0]:
            continue
        ray = points[:, v, u] - pose[:3, 3]
        distance = np.linalg.norm(ray)
        visible = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # the geometry groups that are rendered
        hit = mujoco.mj_ray(model, data, pose[:3, 3], ray / distance, visible, 1, -1, np.zeros(1, dtype=np.int32))
        errors.append(abs(hit - distance))
    assert len(errors) > 100
    assert np.median(errors) < 0.002
    assert np.mean(np.array(errors) < 0.01) > 0.9  # the rest lies on edges, where half a pixel decides


def test_the_hand_is_where_its_state_says(environments):
    environment = environments()
    for seed in range(3):
        observation, _ = environment.reset(seed=seed)
        points = points_of(environment, observation).flatten(1)
        hand = torch.from_numpy(observation["agent_pos"][:3])
        assert (points - hand[:, None]).norm(dim=0).min() < 0.06


def test_extrinsics_are_rigid_and_look_at_the_table(environments):
    for cameras in ("train", "far"):
        observation, _ = environments(cameras).reset(seed=1)
        pose = torch.from_numpy(observation[EXTRINSICS_KEY])
        check_rigid(pose, "the simulated pose")
        to_target = torch.tensor(LOOK_AT) - pose[:3, 3]
        torch.testing.assert_close(to_target / to_target.norm(), pose[:3, 2], atol=1e-3, rtol=0)
        assert pose[2, 1] < 0  # y is down


@pytest.mark.parametrize("name", CAMERA_RANGES)
def test_cameras_stand_within_their_range(name):
    cameras, generator = CAMERA_RANGES[name], np.random.default_rng(0)
    drawn = [cameras.draw(generator) for _ in range(50)]
    for camera in drawn:
        offset = camera.azimuth - 225.0
        assert any(low - 1e-9 <= offset <= high + 1e-9 for low, high in cameras.azimuth)
        assert cameras.elevation[0] <= camera.elevation <= cameras.elevation[1]
        assert cameras.distance[0] <= camera.distance <= cameras.distance[1]
    # Every interval of offsets is drawn from.
    for low, high in cameras.azimuth:
        assert any(low <= camera.azimuth - 225.0 <= high for camera in drawn)


# --- episodes -----------------------------------------------------------------------------------------------------


def flat(observation: dict) -> dict[str, np.ndarray]:
    return {**{k: v for k, v in observation.items() if k != "pixels"}, **observation["pixels"]}


def test_a_seed_is_an_episode(environments):
    environment = environments()
    first, _ = environment.reset(seed=3)
    target = environment.simulator_state.copy()
    stepped = environment.step(np.array([0.5, -0.2, 0.1, 1.0]))
    other, _ = environment.reset(seed=4)
    assert np.abs(first[EXTRINSICS_KEY] - other[EXTRINSICS_KEY]).max() > 0.01
    assert np.abs(target[4:7] - environment.simulator_state[4:7]).max() > 0.005
    again, _ = environment.reset(seed=3)
    for key, value in flat(first).items():
        assert np.array_equal(value, flat(again)[key]), key
    stepped_again = environment.step(np.array([0.5, -0.2, 0.1, 1.0]))
    for key, value in flat(stepped[0]).items():
        assert np.array_equal(value, flat(stepped_again[0])[key]), key
    assert stepped[1:] == stepped_again[1:]


def test_episodes_without_a_seed_differ(environments):
    environment = environments()
    environment.reset(seed=3)
    first, _ = environment.reset()
    second, _ = environment.reset()
    assert np.abs(first[EXTRINSICS_KEY] - second[EXTRINSICS_KEY]).max() > 1e-3


def test_observations_are_as_declared(environments):
    environment = environments()
    observation, _ = environment.reset(seed=0)
    for _ in range(2):
        assert environment.observation_space.contains(observation)
        millimetres = observation[DEPTH_KEY]
        assert np.array_equal(millimetres, millimetres.round())
        assert 0 <= millimetres.min() < millimetres.max() <= 10_000
        observation, *_ = environment.step(environment.action_space.sample())
    assert environment.render().shape == (4 * SIZE, 4 * SIZE, 3)


def test_an_episode_ends_after_its_length():
    environment = RgbdMetaworldEnv(TASK, "fixed", 32, episode_length=2)
    environment.reset(seed=0)
    ends = [environment.step(np.zeros(4))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    environment.close()
    environment.close()  # closing twice is harmless
    environment.reset(seed=0)  # and it may be used again
    environment.close()


@pytest.mark.parametrize("action", [[0.0, 0.0, 0.0, np.nan], [0.0, 0.0, np.inf, 0.0], [0.0] * 3, [[0.0] * 4]])
def test_an_action_that_is_none_is_refused(environments, action):
    environments().reset(seed=0)
    with pytest.raises(ValueError, match="An action must be 4 finite numbers"):
        environments().step(np.array(action))


def test_the_expert_presses_the_button(environments):
    environment = environments()
    for seed in range(5):
        environment.reset(seed=seed)
        expert = make_expert(find_task(TASK))
        done = False
        while not done:
            _, _, success, truncated, info = environment.step(expert.get_action(environment.simulator_state))
            done = success or truncated
        assert success, f"seed {seed}"
        assert info["is_success"]


# --- LeRobot ------------------------------------------------------------------------------------------------------


def test_lerobot_sees_what_the_configuration_declares():
    config = MetaworldRgbdEnv(image_size=32, episode_length=3)
    assert set(config.features) == set(config.features_map)
    declared = env_to_policy_features(config)
    assert declared["observation.images.front_depth"].shape == (1, 32, 32)
    vector = config.create_envs(2)["metaworld_rgbd"][0]
    observation, _ = vector.reset(seed=[0, 1])
    arrived = preprocess_observation(observation)
    assert set(arrived) | {"action"} == set(declared)
    for key, value in arrived.items():
        shape = tuple(value.shape)
        if key == "observation.images.front_depth":  # LeRobot leaves depth channel-last
            shape = (shape[0], shape[3], *shape[1:3])
        assert shape == (2, *declared[key].shape), key
        assert value.dtype == torch.float32
    assert not torch.equal(
        arrived["observation.calibration.front.extrinsics"][0], arrived["observation.calibration.front.extrinsics"][1]
    )
    assert list(vector.call("task_description")) == ["press the button from the top"] * 2
    assert vector.call("_max_episode_steps")[0] == 3
    vector.close()


def test_an_unknown_task_lists_those_there_are():
    for make in (lambda: RgbdMetaworldEnv("press-everything"), lambda: find_task("press-everything")):
        with pytest.raises(ValueError, match=r"no simulated task 'press-everything'") as caught:
            make()
        for name in [*WIDE_TASKS, "reach-v3", "drawer-open-v3"]:
            assert name in str(caught.value)


def test_an_unknown_camera_range_lists_those_there_are():
    with pytest.raises(
        ValueError, match=r"no camera range 'everywhere'; choose one of: fixed, train, outside, far, wide"
    ):
        RgbdMetaworldEnv(TASK, cameras="everywhere")


def test_a_task_of_metaworld_works_by_its_own_name():
    task = find_task("reach-v3")
    assert dataclasses.astuple(task)[:3] == ("reach-v3", "reach", None)
    environment = RgbdMetaworldEnv("reach-v3", "fixed", 32)
    environment.reset(seed=0)
    for _ in range(2):  # its expert needs the goal, which Meta-World hides from policies
        goal = environment._simulator._target_pos
        np.testing.assert_allclose(environment.simulator_state[-3:], goal)
        environment.step(np.zeros(4))
    environment.close()


# --- recording ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The folder of a dataset of two episodes, and what recording reported."""
    root = tmp_path_factory.mktemp("data") / "two"
    return root, list(record(root, "local/two", TASK, episodes=2, image_size=32))


def test_a_recording_is_a_dataset_with_depth(recorded):
    root, progress = recorded
    assert progress[-1] == (2, True)
    dataset = LeRobotDataset("local/two", root=root)
    assert dataset.meta.total_episodes == 2
    depth = dataset.meta.features["observation.images.front_depth"]
    assert depth["info"]["is_depth_map"]
    assert {"q01", "q99"} <= set(dataset.meta.stats["action"])
    frame = dataset[0]
    assert frame["task"] == "press the button from the top"
    assert frame["action"].shape == frame["observation.state"].shape == (4,)


def test_what_is_recorded_is_what_the_environment_showed(recorded):
    dataset = LeRobotDataset("local/two", root=recorded[0])
    environment = RgbdMetaworldEnv(TASK, "train", 32)
    seen, _ = environment.reset(seed=FIRST_SEED)
    action = make_expert(find_task(TASK)).get_action(environment.simulator_state).clip(-1.0, 1.0)
    environment.close()
    frame = dataset[0]
    assert np.array_equal(frame["observation.images.front_depth"].squeeze().numpy(), seen[DEPTH_KEY].squeeze())
    assert np.array_equal(frame["observation.calibration.front.extrinsics"].numpy(), seen[EXTRINSICS_KEY].flatten())
    assert np.array_equal(frame["observation.state"].numpy(), seen["agent_pos"])
    np.testing.assert_allclose(frame["action"].numpy(), action, atol=1e-6)  # the expert's own, without the noise
    pixels = (255 * frame["observation.images.front"]).round().permute(1, 2, 0).numpy()
    assert np.array_equal(pixels, seen["pixels"]["front"])


def test_quantiles_are_those_of_all_frames(recorded):
    """Not the mean of the episodes' own, which is what LeRobot writes (to within its histogram's bins)."""
    dataset = LeRobotDataset("local/two", root=recorded[0])
    for key in ("observation.state", "action"):
        frames, stats = np.stack(dataset.hf_dataset[key]), dataset.meta.stats[key]
        spread = stats["max"] - stats["min"] + 1e-9
        order = np.sort(frames, axis=0)
        for name, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
            rank = share * (len(frames) - 1)
            below, above = order[max(int(rank) - 1, 0)], order[min(int(rank) + 2, len(frames) - 1)]
            assert (stats[name] >= below - 0.002 * spread).all(), (key, name)
            assert (stats[name] <= above + 0.002 * spread).all(), (key, name)
        assert np.array_equal(stats["min"], frames.min(axis=0))


def test_quantiles_of_a_dataset_can_be_recomputed(recorded, tmp_path):
    """What LeRobot averaged over episodes is put right, and nothing else is touched."""
    root = tmp_path / "copy"
    shutil.copytree(recorded[0], root)
    right = json.loads((root / "meta" / "stats.json").read_text())
    wrong = json.loads(json.dumps(right))
    wrong["observation.state"]["q99"] = wrong["observation.state"]["q50"]
    (root / "meta" / "stats.json").write_text(json.dumps(wrong))
    before, after = write_frame_quantiles(root)["observation.state"]
    assert (before <= after).all()
    assert (before < after).any()
    assert json.loads((root / "meta" / "stats.json").read_text()) == right
    with pytest.raises(FileNotFoundError, match=r"holds no LeRobotDataset"):
        write_frame_quantiles(tmp_path / "nowhere")


def test_a_recording_brings_its_calibration(recorded):
    root, _ = recorded
    camera = read_dataset_calibration(LeRobotDataset("local/two", root=root).meta, {}).cameras["front"]
    assert camera.size == [32, 32]
    assert camera.intrinsics[2:] == [15.5, 15.5]
    assert camera.extrinsics is None  # the pose comes with every frame


def test_a_recording_is_never_overwritten(recorded):
    root, _ = recorded
    before = sorted(path.name for path in root.rglob("*"))
    with pytest.raises(FileExistsError, match=r"two already exists; choose another folder"):
        next(record(root, "local/two", TASK, episodes=1, image_size=32))
    assert sorted(path.name for path in root.rglob("*")) == before


def test_a_recording_that_was_broken_off_leaves_no_dataset_and_can_be_made_anew(tmp_path):
    recording = record(tmp_path / "one", "local/one", TASK, episodes=2, image_size=32)
    next(recording)
    recording.close()
    assert not (tmp_path / "one").exists()
    list(record(tmp_path / "one", "local/one", TASK, episodes=1, image_size=32))
    assert [path.name for path in tmp_path.iterdir()] == ["one"]
    assert LeRobotDataset("local/one", root=tmp_path / "one").meta.total_episodes == 1


def test_features_are_typed_as_lerobot_types_them():
    types = {key: feature.type for key, feature in MetaworldRgbdEnv().features.items()}
    assert types["images.front_depth"] == FeatureType.VISUAL
    assert types["calibration.front.extrinsics"] == FeatureType.STATE


@pytest.mark.parametrize("sensor", ["noisy", "off", "calibration-5"])
def test_a_sensor_changes_what_is_measured_and_nothing_else(sensor):
    """Same seed, same scene, same RGB: only depth, or only the reported pose, differs."""
    ideal, faulty = (RgbdMetaworldEnv("button-press-topdown-wide", "outside", 28, sensor=s) for s in ("ideal", sensor))
    try:
        first, _ = ideal.reset(seed=5)
        second, _ = faulty.reset(seed=5)
        for _ in range(2):
            differs = {
                "depth": (first[DEPTH_KEY] != second[DEPTH_KEY]).any(),
                "pose": (first[EXTRINSICS_KEY] != second[EXTRINSICS_KEY]).any(),
                "rgb": (first["pixels"][CAMERA] != second["pixels"][CAMERA]).any(),
                "state": (first["agent_pos"] != second["agent_pos"]).any(),
            }
            wrong_pose = sensor.startswith("calibration")
            assert differs == {"depth": not wrong_pose, "pose": wrong_pose, "rgb": False, "state": False}
            first, *_ = ideal.step(np.array([0.5, -0.5, 0.2, 1.0]))
            second, *_ = faulty.step(np.array([0.5, -0.5, 0.2, 1.0]))
    finally:
        ideal.close()
        faulty.close()


def test_an_unknown_sensor_is_named():
    with pytest.raises(ValueError, match="no depth sensor 'broken'"):
        RgbdMetaworldEnv("button-press-topdown-wide", sensor="broken")


def test_an_environment_whose_renderer_does_not_start_can_be_closed(monkeypatch):
    def no_context(*_):
        raise RuntimeError("no rendering context")

    monkeypatch.setattr(mujoco, "MjrContext", no_context)
    environment = RgbdMetaworldEnv(TASK)
    with pytest.raises(RuntimeError, match="no rendering context"):
        environment.reset(seed=0)
    environment.close()
