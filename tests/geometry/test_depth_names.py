"""A dataset whose depth has another name than LeRobot's: training, evaluation and a robot read it alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy, make_pre_post_processors
from torch.utils.data import default_collate
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.geometry.calibration import Rig, write_calibration_file
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.dataset_calibration import (
    read_dataset_calibration,
    write_dataset_calibration,
)
from lerobot_policy_pi05_geometry.geometry.keys import depth_features
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from pi05_geometry_cli import app
from tests.entry_points import chunk_of, make_config, redraw

NAME, SIZE = "local/other-names", 28
AXES = ["height", "width", "channels"]
POSE = [[0.0, -0.6, 0.8, -0.5], [-1.0, 0.0, 0.0, 0.1], [0.0, -0.8, -0.6, 0.7], [0.0, 0.0, 0.0, 1.0]]
FRONT = CameraCalibration([30.0, 30.0, 13.5, 13.5], [SIZE, SIZE], POSE)


def write_dataset(root: Path, depth_key: str, flagged: bool = True) -> Path:
    """One episode of RGB and depth; a fifth of the pixels are holes, stored as 65535."""
    info = {"is_depth_map": True, "depth_unit": "mm"} if flagged else None
    features = {
        "observation.images.front": {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": AXES},
        depth_key: {"dtype": "image", "shape": (SIZE, SIZE, 1), "names": AXES, "info": info},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (5,), "names": None},
    }
    dataset = LeRobotDataset.create(NAME, fps=10, features=features, root=root, use_videos=False)
    random = np.random.default_rng(0)
    for _ in range(8):
        depth = random.integers(300, 1500, (SIZE, SIZE, 1))
        depth[random.random(depth.shape) < 0.2] = 65535
        dataset.add_frame(
            {
                "observation.images.front": random.integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8),
                depth_key: depth.astype(np.uint16),
                "observation.state": random.uniform(-1, 1, 7).astype(np.float32),
                "action": random.uniform(-1, 1, 5).astype(np.float32),
                "task": "push",
            }
        )
    dataset.save_episode()
    dataset.finalize()
    return root


def fresh_config(**changes) -> PI05GeometryConfig:
    """As `--policy.type=pi05_geometry` makes it, without features."""
    return make_config(input_features={}, output_features={}, calibration={}, **changes)


def policy_and_batch(root: Path, config: PI05GeometryConfig) -> tuple[PI05GeometryPolicy, dict]:
    """What lerobot-train builds of a dataset, and a preprocessed batch of it."""
    meta = LeRobotDatasetMetadata(NAME, root=root)
    torch.manual_seed(0)
    policy = redraw(make_policy(config, ds_meta=meta)).train()
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    dataset = LeRobotDataset(NAME, root=root, delta_timestamps={"action": [i / 10 for i in range(6)]})
    return policy, preprocess(default_collate([dataset[i] for i in range(3)]))


@pytest.mark.parametrize(
    ("key", "flagged"),
    [
        ("observation.images.depth.front", True),
        ("observation.depth_front", True),
        ("observation.images.range", False),
    ],
)
def test_depth_of_another_name_trains_and_acts_as_lerobots(tmp_path, key, flagged):
    given = {} if flagged else {"depth_keys": {"front": key}}
    root = write_dataset(tmp_path / "other", key, flagged)
    write_dataset_calibration(root, Rig({"front": FRONT}), given.get("depth_keys"))
    usual = write_dataset(tmp_path / "usual", "observation.images.front_depth")
    write_dataset_calibration(usual, Rig({"front": FRONT}))
    policy, batch = policy_and_batch(root, fresh_config(**given))
    expected, expected_batch = policy_and_batch(usual, fresh_config())

    assert policy.geometry.source.cameras == ("front",)
    assert set(policy.config.image_features) == {"observation.images.front"}
    loss, _ = policy(batch)
    assert torch.equal(loss, expected(expected_batch)[0])
    loss.backward()
    assert policy.geometry.adapter.fc_in.weight.grad.any()

    policy.save_pretrained(tmp_path / "saved")
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path / "saved")
    actions = chunk_of(loaded, batch)
    renamed = {"observation.images.front_depth" if k == key else k: v for k, v in batch.items()}
    assert torch.equal(chunk_of(loaded, renamed), actions), "a robot that uses LeRobot's name"


def test_depth_maps_never_pass_for_rgb_where_geometry_is_off(tmp_path):
    root = write_dataset(tmp_path / "other", "observation.images.depth.front")
    policy, batch = policy_and_batch(root, fresh_config(geometry_source="none"))
    assert set(policy.config.image_features) == {"observation.images.front"}
    assert policy(batch)[0].isfinite()


# --- where a dataset keeps its calibration --------------------------------------------------------------------------


@pytest.fixture
def root(tmp_path) -> Path:
    return write_dataset(tmp_path / "data", "observation.images.front_depth")


def meta_of(root: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata(NAME, root=root)


def test_calibration_is_kept_in_the_depth_features_info(root):
    before = meta_of(root).features
    write_dataset_calibration(root, Rig({"front": FRONT}))
    meta = meta_of(root)
    assert read_dataset_calibration(meta, {}).cameras == {"front": FRONT}
    info = meta.features["observation.images.front_depth"]["info"]
    assert info["is_depth_map"]
    assert info.pop("calibration")["frame"] == "base"
    assert meta.features == before, "nothing else changed"


def test_a_command_stores_a_calibration_file_in_a_dataset(root, tmp_path):
    write_calibration_file(tmp_path / "rig.json", Rig({"front": FRONT}))
    result = CliRunner().invoke(app, ["store-calibration", str(tmp_path / "rig.json"), f"--dataset.root={root}"])
    assert result.exit_code == 0, result.output
    assert read_dataset_calibration(meta_of(root), {}).cameras == {"front": FRONT}
    with pytest.raises(FileNotFoundError, match="holds no LeRobotDataset"):
        write_dataset_calibration(tmp_path, Rig({"front": FRONT}))


def test_a_camera_without_depth_keeps_it_beside_its_images(tmp_path):
    root = write_dataset(tmp_path / "data", "observation.images.wrist_depth")
    write_dataset_calibration(root, Rig({"front": FRONT}))
    assert "calibration" in meta_of(root).features["observation.images.front"]["info"]
    assert read_dataset_calibration(meta_of(root), {}).cameras == {"front": FRONT}


def test_a_calibration_of_no_camera_of_the_dataset_is_refused(root):
    with pytest.raises(ValueError, match=r"no camera 'back' to store a calibration of; its cameras are front\."):
        write_dataset_calibration(root, Rig({"back": FRONT}))


def test_two_places_that_contradict_each_other_are_refused(root):
    write_dataset_calibration(root, Rig({"front": FRONT}))
    path = root / "meta" / "calibration.json"
    write_calibration_file(path, Rig({"front": FRONT}))
    assert read_dataset_calibration(meta_of(root), {}).cameras == {"front": FRONT}
    write_calibration_file(path, Rig({"front": replace(FRONT, intrinsics=[31.0, 30.0, 13.5, 13.5])}))
    with pytest.raises(ValueError, match=r"Camera 'front' has two calibrations that differ.*calibration_path") as error:
        read_dataset_calibration(meta_of(root), {})
    assert str(error.value).endswith(".")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frame": "world"}, "only 'base'"),
        ({"intrinsics": [0, 0, 0, 0]}, "singular"),
        ({"size": None}, "Camera 'front'"),
        ({"unit": "m"}, "cannot be read"),
    ],
)
def test_an_unusable_entry_is_refused_with_its_file(root, change, said):
    write_dataset_calibration(root, Rig({"front": FRONT}))
    meta = meta_of(root)
    meta.features["observation.images.front_depth"]["info"]["calibration"].update(change)
    with pytest.raises(ValueError, match=said) as error:
        read_dataset_calibration(meta, {})
    assert "info.json" in str(error.value)


# --- streaming ------------------------------------------------------------------------------------------------------


def test_what_streaming_does_to_the_unit_is_said(root):
    """LeRobot 0.6.1 ignores `depth_output_unit` with streaming: whoever declares metres on both sides is told why."""
    write_dataset_calibration(root, Rig({"front": FRONT}))
    config = fresh_config(depth_unit="m")
    training = TrainPipelineConfig(
        dataset=DatasetConfig(NAME, root=str(root), streaming=True, depth_output_unit="m"), policy=config
    )
    sample = next(iter(make_dataset(training)))
    millimetres = sample["observation.images.front_depth"].float().median() > 20
    policy, batch = policy_and_batch(root, config)
    batch["observation.images.front_depth"] = sample["observation.images.front_depth"].float()[None]
    if millimetres:
        with pytest.raises(ValueError, match=r"ignores that option with --dataset.streaming=true"):
            policy.geometry.train()(batch)
    else:  # LeRobot's next release
        policy.geometry.train()(batch)


@pytest.mark.parametrize("shape", [(9, 12, 3), (3, 9, 12)])
def test_a_depth_map_in_colours_is_a_camera_of_its_own_name(shape):
    """Its distances are lost: it holds no depth, and a calibration belongs to the RGB camera `top_depth`."""
    features = {
        f"observation.images.{name}_depth": {"dtype": "image", "shape": size}
        for name, size in (("top", shape), ("front", (9, 12, 1)))
    }
    assert depth_features(features, {}) == {"front": "observation.images.front_depth"}
