"""Two robots' datasets, merged by LeRobot's own tools: in training every frame is seen through its own robot's calibration."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_edit_dataset import DeleteEpisodesConfig, EditDatasetConfig, MergeConfig, edit_dataset
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.data.quantiles import write_frame_quantiles
from lerobot_policy_pi05_geometry.geometry.calibration import Rig
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration, Mount
from lerobot_policy_pi05_geometry.geometry.dataset_calibration import (
    read_dataset_calibration,
    write_dataset_calibration,
)
from lerobot_policy_pi05_geometry.geometry.keys import RAW_STATE, RIG, depth_key
from lerobot_policy_pi05_geometry.geometry.kinematics import ForwardKinematics
from lerobot_policy_pi05_geometry.geometry.rgbd import RgbdSource
from lerobot_policy_pi05_geometry.robot.merge_rigs import labelled, merge_rigs
from pi05_geometry_cli import app
from tests.geometry.arms import STATE_NAMES, so101_like
from tests.geometry.scenes import calibrated, depth_of_plane, generator, looking_at, uniform

SIDE, FRAMES = 28, 4
FLOOR = {0: -0.6, 1: -0.4}  # where each robot's table is in its base frame, metres


def rig_of(number: int) -> Rig:
    """A fixed camera on a robot that counts millimetres, and one on the gripper of another that counts tenths."""
    camera = calibrated(SIDE, SIDE, focal=(0.9, 1.3)[number])
    if number == 0:
        pose = looking_at(torch.tensor([0.5, 0.6, 0.7]), torch.tensor([0.0, 0.0, -0.6]))
        return Rig({"front": replace(camera, extrinsics=pose.tolist(), depth_scale=1e-3)})
    link = ForwardKinematics(so101_like(), ["gripper"])(torch.zeros(1, 6, dtype=torch.float64))[0, 0]
    down = looking_at(torch.tensor([0.1, -0.2, 0.3]), torch.tensor([0.0, 0.0, -0.4]))
    mount = Mount("arm", "gripper", (torch.linalg.inv(link) @ down).tolist())
    return Rig({"front": replace(camera, mount=mount, depth_scale=1e-4)}, {"arm": so101_like()})


def pose_of(rig: Rig, state: torch.Tensor) -> torch.Tensor:
    """`base_T_camera` (4, 4) at a state (6,)."""
    camera = rig.cameras["front"]
    if camera.mount is None:
        return torch.tensor(camera.extrinsics, dtype=torch.float64)
    link = ForwardKinematics(rig.arms["arm"], ["gripper"])(state[None].double())[0, 0]
    return link @ torch.tensor(camera.mount.link_T_camera, dtype=torch.float64)


def record(root: Path, number: int) -> Path:
    """Two episodes in which a camera sees the flat table."""
    axes = ["height", "width", "channels"]
    depth = {"is_depth_map": True, "depth_unit": "mm"}
    features = {
        "observation.images.front": {"dtype": "image", "shape": (SIDE, SIDE, 3), "names": axes},
        depth_key("front"): {"dtype": "image", "shape": (SIDE, SIDE, 1), "names": axes, "info": depth},
        "observation.state": {"dtype": "float32", "shape": (6,), "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": (6,), "names": STATE_NAMES},
    }
    name = f"local/{root.name}"
    dataset = LeRobotDataset.create(
        name, fps=10, features=features, root=root, robot_type="so_follower", use_videos=False
    )
    random, rig = generator(number), rig_of(number)
    for _ in range(2):
        for _ in range(FRAMES):
            state = uniform(random, -8, 8, 6)
            camera = rig.cameras["front"]
            seen = depth_of_plane(FLOOR[number], pose_of(rig, state), camera)[0, 0]
            counts = (seen / camera.depth_scale).round().clamp(0, 65534).numpy().astype(np.uint16)
            image = np.full((SIDE, SIDE, 3), int(random.initial_seed()) * 90 + 60, np.uint8)
            frame = {"observation.images.front": image, depth_key("front"): counts[..., None]}
            dataset.add_frame(
                {**frame, "observation.state": state.numpy(), "action": state.numpy() / 9, "task": "push"}
            )
        dataset.save_episode()
    dataset.finalize()
    write_frame_quantiles(root, name, ("observation.state", "action"))
    write_dataset_calibration(root, rig)
    return root


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("rigs")
    return [record(folder / f"arm{number}", number) for number in FLOOR]


RIGS = [0] * 2 * FRAMES + [1] * 2 * FRAMES + [0] * 2 * FRAMES  # of every frame of `merged`


@pytest.fixture(scope="module")
def merged(two) -> Path:
    """Two rigs, and the first one's data once more."""
    output, again = two[0].parent / "merged", two[0].parent / "again"
    shutil.copytree(two[0], again)
    arguments = ["merge-rigs", *map(str, two), str(again), f"--output={output}"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "again: rig 0" in result.output.replace("\n", "")
    return output


def open_dataset(root: Path) -> LeRobotDataset:
    return LeRobotDataset("local/merged", root=root)


def merge_with_lerobot(roots: list[Path], output: Path) -> None:
    names = [f"local/{root.name}" for root in roots]
    merge = MergeConfig(repo_ids=names, roots=[str(root) for root in roots])
    edit_dataset(EditDatasetConfig(merge, new_repo_id="local/merged", new_root=str(output)))


def test_every_frame_says_which_rig_it_is_of(two, merged):
    dataset = open_dataset(merged)
    assert dataset.hf_dataset.with_format(None)[RIG] == RIGS
    calibration = read_dataset_calibration(dataset.meta, {})
    assert calibration.rigs == {"0": rig_of(0), "1": rig_of(1)}
    assert not calibration.cameras
    for source, start in zip(two, (0, 2 * FRAMES), strict=True):
        for number, frame in enumerate(open_dataset(source)):
            assert torch.equal(frame[depth_key("front")], dataset[start + number][depth_key("front")])


def test_lerobots_merge_refuses_two_rigs(two, tmp_path):
    with pytest.raises(ValueError, match="Same features is expected"):
        merge_with_lerobot(two, tmp_path / "raw")


@pytest.mark.long
def test_lerobots_command_merges_labelled_copies_as_ours_does(two, merged, tmp_path):
    calibration = read_dataset_calibration(open_dataset(merged).meta, {})
    copies = [tmp_path / "arm0", tmp_path / "arm1"]
    for number, (root, copy) in enumerate(zip(two, copies, strict=True)):
        labelled(LeRobotDataset(f"local/{root.name}", root=root), number, calibration, copy)
    merge_with_lerobot(copies, tmp_path / "both")
    found = open_dataset(tmp_path / "both")
    assert found.hf_dataset.with_format(None)[RIG] == RIGS[: 4 * FRAMES]
    assert read_dataset_calibration(found.meta, {}) == calibration


def test_deleting_an_episode_leaves_every_other_frame_its_rig(merged, tmp_path):
    delete = DeleteEpisodesConfig(episode_indices=[0])
    edit_dataset(EditDatasetConfig(delete, "local/merged", root=str(merged), new_root=str(tmp_path / "less")))
    assert open_dataset(tmp_path / "less").hf_dataset.with_format(None)[RIG] == RIGS[FRAMES:]


@pytest.mark.train
def test_a_training_step_sees_every_frame_through_its_own_rig(merged, tmp_path, monkeypatch):
    """`lerobot-train` itself: the mean point of every cell lies on the table of the robot that the frame is of."""
    from lerobot.scripts import lerobot_train

    seen = []
    measure = RgbdSource.forward

    def forward(source, batch, check=True):
        found = measure(source, batch, check)
        seen.append((batch[RIG].flatten(), batch[RAW_STATE], found.features[..., :3], found.valid))
        return found

    monkeypatch.setattr(RgbdSource, "forward", forward)
    arguments = [
        "--policy.type=pi05_geometry", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.paligemma_variant=tiny",
        "--policy.action_expert_variant=tiny", f"--policy.image_resolution=[{SIDE},{SIDE}]", "--policy.geometry_grid=4",
        "--policy.chunk_size=6", "--policy.n_action_steps=2", "--policy.max_action_dim=6", "--dataset.repo_id=local/merged",
        f"--dataset.root={merged}", f"--output_dir={tmp_path / 'run'}", "--steps=1", "--num_workers=0",
        "--wandb.enable=false", f"--batch_size={len(RIGS)}",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
    lerobot_train.main()
    [(rigs, states, points, valid)] = seen
    assert rigs.bincount().tolist() == [4 * FRAMES, 2 * FRAMES]
    for row, number in enumerate(rigs.tolist()):
        rig = rig_of(number)
        pose = pose_of(rig, states[row])
        camera = rig.cameras["front"]
        assert valid[row].any()
        there = points[row][valid[row]].view(-1, 3)
        assert (there[:, 2] - FLOOR[number]).abs().max() < 2e-3
        pixels = _means(depth_of_plane(FLOOR[number], pose, camera)[0, 0].double(), pose, camera)[valid[row].flatten()]
        assert (there - pixels).abs().max() < 2e-3
    config = json.loads((tmp_path / "run/checkpoints/last/pretrained_model/config.json").read_text())
    assert set(config["rigs"]) == {"0", "1"}


def _means(depth: torch.Tensor, pose: torch.Tensor, camera: CameraCalibration) -> torch.Tensor:
    """Mean point (16, 3) of the cells of a 4 x 4 grid, over the pixels that see the table."""
    fx, fy, cx, cy = camera.intrinsics
    v, u = torch.meshgrid(torch.arange(SIDE).double(), torch.arange(SIDE).double(), indexing="ij")
    points = torch.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth, torch.ones_like(depth)], -1) @ pose.mT
    weight = ((depth > 0.02) & (depth < 10.0)).double()
    side = SIDE // 4

    def sums(values: torch.Tensor) -> torch.Tensor:
        return values.unflatten(1, (4, side)).unflatten(0, (4, side)).sum(dim=(1, 3)).flatten()

    return torch.stack([sums(points[..., i] * weight) / sums(weight) for i in range(3)], dim=-1)


# --- what is refused ----------------------------------------------------------------------------------------------------


def copy_with(root: Path, copy: Path, change) -> Path:
    """A dataset with another meta/info.json; its data is not needed to refuse it."""
    shutil.copytree(root, copy)
    info = json.loads((copy / "meta" / "info.json").read_text())
    change(info["features"])
    (copy / "meta" / "info.json").write_text(json.dumps(info))
    return copy


def refused(roots: list[Path], output: Path) -> str:
    with pytest.raises((ValueError, FileNotFoundError, FileExistsError)) as caught:
        merge_rigs(roots, output)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    return message


def test_what_cannot_be_merged_is_refused(two, merged, tmp_path):
    output = tmp_path / "out"
    assert "two datasets or more" in refused(two[:1], output)
    assert "exists already" in refused(two, merged)
    assert "holds no LeRobotDataset" in refused([two[0], tmp_path / "nowhere"], output)
    assert "of several rigs already" in refused([two[0], merged], output)
    bare = copy_with(two[1], tmp_path / "bare", lambda f: f[depth_key("front")]["info"].pop("calibration"))
    assert "carries no calibration; store it with" in refused([two[0], bare], output)

    def more(features: dict) -> None:
        features["observation.images.front"]["info"] = {
            "calibration": features[depth_key("front")]["info"]["calibration"]
        }
        features["observation.images.top"] = features["observation.images.front"]

    other = copy_with(two[1], tmp_path / "other", more)
    assert "Camera(s) top are calibrated in only one of" in refused([two[0], other], output)
    assert not output.exists()


def test_depth_that_was_encoded_with_other_bounds_is_refused(two, tmp_path):
    """LeRobot's merge would leave bounds of null, and decode with its defaults."""

    def as_video(low: float):
        def change(features: dict) -> None:
            features[depth_key("front")]["dtype"] = "video"
            features[depth_key("front")]["info"] |= {"video.depth_min": low, "video.depth_max": 3.0}

        return change

    roots = [copy_with(two[n], tmp_path / f"{n}", as_video(low)) for n, low in enumerate((0.1, 0.2))]
    assert "with the same depth_min and depth_max" in refused(roots, tmp_path / "out")
