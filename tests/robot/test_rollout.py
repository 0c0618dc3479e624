"""LeRobot's own SO-101 and RealSense classes over stubs: recorded, trained on, and rolled out, with every point "
"where the scene is."""

import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

pytest.importorskip("mujoco")

from lerobot_policy_pi05_geometry.geometry.calibration import read_calibration_file, write_calibration_file
from lerobot_policy_pi05_geometry.geometry.dataset_calibration import write_dataset_calibration
from lerobot_policy_pi05_geometry.geometry.keys import RAW_STATE, depth_key
from lerobot_policy_pi05_geometry.geometry.rgbd import RgbdSource
from tests.geometry.arms import JOINTS
from tests.robot.stubs import (
    DEPTH_SCALE,
    HEIGHT,
    OFFSETS,
    WIDTH,
    MotorBus,
    World,
    intrinsics,
    make_pyrealsense2,
    true_calibration,
)

pytestmark = [pytest.mark.sim, pytest.mark.train]

GRID = 4
TOLERANCE = 0.002  # metres


@pytest.fixture(scope="module")
def world():
    """LeRobot's robots and cameras find a MuJoCo arm below them."""
    from lerobot.cameras.realsense import camera_realsense
    from lerobot.robots.so_follower import so_follower

    made = World()
    MotorBus.world = made
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(so_follower, "FeetechMotorsBus", MotorBus)
        patch.setattr(camera_realsense, "rs", make_pyrealsense2(made))
        patch.setattr(camera_realsense, "require_package", lambda *_, **__: None)
        # A frame may be 500 ms old, and warming up takes `warmup_s`; on a machine that is busy with other things, the cameras'
        # clock runs slower for the one and faster for the other.
        slow = SimpleNamespace(
            perf_counter=lambda: time.perf_counter() / 100, time=lambda: 100 * time.time(), sleep=time.sleep
        )
        patch.setattr(camera_realsense, "time", slow)
        yield made


def cameras_option() -> str:
    settings = f"width: {WIDTH}, height: {HEIGHT}, fps: 30, use_depth: true, warmup_s: 30"
    return (
        f"{{front: {{type: intelrealsense, serial_number_or_name: '111', {settings}}}, "
        f"wrist: {{type: intelrealsense, serial_number_or_name: '222', {settings}}}}}"
    )


@pytest.fixture(scope="module")
def dataset(world, tmp_path_factory) -> Path:
    """Two short episodes of an arm that jumps about, recorded from LeRobot's robot, depth as LeRobot's video."""
    from lerobot.cameras.realsense import RealSenseCameraConfig
    from lerobot.robots.so_follower import SO101FollowerConfig
    from lerobot.robots.so_follower.so_follower import SOFollower

    shape = {"width": WIDTH, "height": HEIGHT, "fps": 30, "use_depth": True, "warmup_s": 30}
    cameras = {
        name: RealSenseCameraConfig(serial_number_or_name=serial, **shape)
        for serial, name in (("111", "front"), ("222", "wrist"))
    }
    folder = tmp_path_factory.mktemp("robot")
    robot = SOFollower(SO101FollowerConfig(port="none", cameras=cameras, id="test", calibration_dir=folder / "motors"))
    robot.connect()
    features = hw_to_dataset_features(robot.observation_features, "observation")
    features |= hw_to_dataset_features(robot.action_features, "action")
    root = folder / "data"
    made = LeRobotDataset.create("local/arm", fps=30, features=features, root=root, robot_type=robot.name)
    random = np.random.default_rng(0)
    for _ in range(2):
        for _ in range(6):
            goal = {f"{joint}.pos": float(random.uniform(-35, 35)) for joint in JOINTS}
            robot.send_action(goal)
            observed = build_dataset_frame(features, robot.get_observation(), "observation")
            made.add_frame({**observed, **build_dataset_frame(features, goal, "action"), "task": "pick"})
        made.save_episode()
    made.finalize()
    robot.disconnect()
    return root


class Watched:
    """Batches that the geometry source saw, with what it made of them."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.seen: list[tuple[dict, torch.Tensor, torch.Tensor]] = []
        measure = RgbdSource.forward

        def forward(source, batch, check=True):
            found = measure(source, batch, check)
            kept = {key: value.clone() for key, value in batch.items() if key == RAW_STATE}
            self.seen.append((kept, found.features.clone(), found.valid.clone()))
            return found

        patch.setattr(RgbdSource, "forward", forward)

    def poses(self) -> int:
        """How many different poses were seen so far."""
        return len({tuple(row) for batch, *_ in list(self.seen) for row in batch[RAW_STATE].round(decimals=2).tolist()})

    def check(self, world: World) -> int:
        """Compare every cell's mean point with the scene itself; returns how many distinct poses there were."""
        renderer = world.renderer()
        compared, poses = 0, set()
        for batch, features, valid in self.seen:
            for row, state in enumerate(batch[RAW_STATE].numpy()):
                motors = dict(zip(JOINTS, state.tolist(), strict=True))
                poses.add(tuple(np.round(state, 2)))
                for view, camera in enumerate(("front", "wrist")):
                    expected = _cell_means(world, renderer, camera, motors)
                    there = valid[row, view].numpy() & np.isfinite(expected).all(axis=1)
                    apart = np.abs(features[row, view, :, :3].numpy() - expected)[there]
                    assert apart.max(initial=0.0) < TOLERANCE, (camera, apart.max(), motors)
                    compared += int(there.sum())
        renderer.close()
        assert compared >= 8 * len(self.seen)
        return len(poses)


def _cell_means(world: World, renderer, camera: str, motors: dict[str, float]) -> np.ndarray:
    """Mean point (G, 3) of each cell, from MuJoCo's depth and its own pose of the camera."""
    depth = world.depth(renderer, camera, motors).astype(np.float64)
    reach = 10.0 * DEPTH_SCALE[camera] / 1e-3  # LeRobot's codec ends at what it takes for 10 m
    fx, fy, cx, cy = intrinsics()
    v, u = np.indices(depth.shape)
    points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth, np.ones_like(depth)], axis=-1)
    points = points @ world.camera_pose(camera, motors).T
    points[(depth >= reach) | (depth <= 0.02)] = np.nan
    rows, columns = HEIGHT // GRID, WIDTH // GRID
    cells = points[..., :3].reshape(GRID, rows, GRID, columns, 3).transpose(0, 2, 1, 3, 4)
    with np.errstate(invalid="ignore"):
        flat = cells.reshape(GRID * GRID, rows * columns, 3)
        return np.array(
            [
                cell[np.isfinite(cell).all(axis=1)].mean(axis=0) if np.isfinite(cell).any() else [np.nan] * 3
                for cell in flat
            ]
        )


def run_in_process(patch: pytest.MonkeyPatch, main, *arguments: str) -> None:
    patch.setattr(sys, "argv", ["lerobot", *arguments])
    main()


def train_arguments(dataset: Path, output: Path) -> list[str]:
    return [
        "--policy.type=pi05_geometry", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.paligemma_variant=tiny",
        "--policy.action_expert_variant=tiny", "--policy.image_resolution=[28,28]", f"--policy.geometry_grid={GRID}",
        "--policy.chunk_size=8", "--policy.n_action_steps=2", "--policy.num_inference_steps=2", "--policy.max_action_dim=6",
        "--policy.geometry_dropout=0", "--policy.image_dropout=0", "--dataset.repo_id=local/arm", f"--dataset.root={dataset}",
        f"--output_dir={output}", "--steps=2", "--save_freq=2", "--batch_size=4", "--num_workers=0", "--wandb.enable=false",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def trained(world, dataset, tmp_path_factory) -> Path:
    """A checkpoint of two steps of `lerobot-train`; every point of its training was checked."""
    from lerobot.scripts import lerobot_train

    output = tmp_path_factory.mktemp("run") / "out"
    with pytest.MonkeyPatch.context() as patch:
        with pytest.raises(ValueError, match=r"no intrinsics.*calibration_path"):
            run_in_process(patch, lerobot_train.main, *train_arguments(dataset, output))
        calibration = true_calibration(world)
        calibration.cameras["wrist"].depth_scale = None
        given = dataset.parent / "calibration.json"
        write_calibration_file(given, calibration)
        with pytest.raises(ValueError, match=r"no depth_scale of camera\(s\) wrist"):  # a D405, before any training
            run_in_process(
                patch,
                lerobot_train.main,
                *train_arguments(dataset, output.with_name("no")),
                f"--policy.calibration_path={given}",
            )
        write_dataset_calibration(dataset, true_calibration(world))
        watched = Watched(patch)
        run_in_process(patch, lerobot_train.main, *train_arguments(dataset, output.with_name("good")))
        assert watched.check(world) >= 6
    return output.with_name("good") / "checkpoints" / "last" / "pretrained_model"


@pytest.mark.parametrize("engine", ["sync", "rtc"])
def test_points_of_both_cameras_are_where_the_scene_is(world, trained, engine, monkeypatch, caplog):
    from lerobot.scripts import lerobot_rollout

    watched = Watched(monkeypatch)
    monkeypatch.setattr(world, "enough", lambda: watched.poses() >= 3)
    more = ["--use_torch_compile=true"] if engine == "sync" else ["--inference.queue_threshold=4"]
    run_in_process(
        monkeypatch, lerobot_rollout.main, "--robot.type=so101_follower", "--robot.port=none", "--robot.id=test",
        f"--robot.cameras={cameras_option()}", f"--robot.calibration_dir={trained.parent / 'motors'}", f"--policy.path={trained}",
        "--task=pick", "--fps=10", "--duration=100", f"--inference.type={engine}", "--return_to_initial_position=false",
        "--device=cpu", *more,
    )  # fmt: skip
    assert watched.check(world) >= 2
    assert "Fatal error" not in caplog.text
    assert "inference error" not in caplog.text


def test_the_checkpoint_carries_the_arm_as_numbers(trained):
    from lerobot.configs import PreTrainedConfig

    config = PreTrainedConfig.from_pretrained(trained)
    assert config.arms["arm"].joints[1].offset == pytest.approx(np.radians(OFFSETS["shoulder_lift"]))
    assert config.calibration["wrist"].mount.link == "gripper"
    assert config.calibration["wrist"].depth_scale == DEPTH_SCALE["wrist"]
    assert config.depth_bounds == {"front": [0.01, 10.0], "wrist": [0.01, 10.0]}
    assert depth_key("wrist") in config.geometry_features


def test_a_calibration_file_of_the_rig_is_what_was_written(world, tmp_path):
    write_calibration_file(tmp_path / "c.json", true_calibration(world))
    assert read_calibration_file(tmp_path / "c.json") == true_calibration(world)
