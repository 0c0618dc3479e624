"""LeRobot's own tools on recorded datasets of one rig: delete, split, merge, new statistics, and training on the result."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_edit_dataset import (
    DeleteEpisodesConfig,
    EditDatasetConfig,
    MergeConfig,
    RecomputeStatsConfig,
    SplitConfig,
    edit_dataset,
)

from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.dataset_calibration import read_dataset_calibration
from lerobot_policy_pi05_geometry.sim.record import record
from tests.training.test_training import arguments, lerobot

pytestmark = pytest.mark.sim

DEPTH, POSE = "observation.images.front_depth", "observation.calibration.front.extrinsics"
NAME = "local/one-rig"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("edited")


@pytest.fixture(scope="module")
def recorded(folder) -> Path:
    """Three short expert episodes."""
    list(record(folder / "recorded", NAME, "button-press-topdown-wide", episodes=3, image_size=28))
    return folder / "recorded"


@pytest.fixture(scope="module")
def merged(recorded, folder) -> Path:
    """The dataset split into two and merged again, with LeRobot's tools."""
    splits = {"first": [0], "rest": [1, 2]}
    edit_dataset(
        EditDatasetConfig(SplitConfig(splits=splits), NAME, root=str(recorded), new_root=str(folder / "parts"))
    )
    parts = [str(folder / "parts" / name) for name in splits]
    edit_dataset(
        EditDatasetConfig(
            MergeConfig(repo_ids=[f"{NAME}_{name}" for name in splits], roots=parts),
            new_repo_id=NAME,
            new_root=str(folder / "merged"),
        )
    )
    return folder / "merged"


def calibration_of(root: Path) -> dict[str, CameraCalibration]:
    return read_dataset_calibration(LeRobotDataset(NAME, root=root).meta, {}).cameras


def geometry_of(root: Path) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Depth and pose of every frame."""
    return [(frame[DEPTH], frame[POSE]) for frame in LeRobotDataset(NAME, root=root)]


def assert_same(found: list[tuple[torch.Tensor, ...]], expected: list[tuple[torch.Tensor, ...]]) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_deleting_an_episode_keeps_the_others_poses_and_the_calibration(recorded, folder):
    edit_dataset(
        EditDatasetConfig(
            DeleteEpisodesConfig(episode_indices=[1]), NAME, root=str(recorded), new_root=str(folder / "deleted")
        )
    )
    episodes = np.asarray(LeRobotDataset(NAME, root=recorded).hf_dataset["episode_index"])
    kept = [frame for frame, episode in zip(geometry_of(recorded), episodes, strict=True) if episode != 1]
    assert_same(geometry_of(folder / "deleted"), kept)
    assert calibration_of(folder / "deleted") == calibration_of(recorded) != {}


def test_splitting_and_merging_give_the_same_frames_and_calibration(recorded, merged):
    assert_same(geometry_of(merged), geometry_of(recorded))
    assert calibration_of(merged) == calibration_of(recorded) != {}


def test_statistics_can_be_recomputed(merged):
    edit_dataset(EditDatasetConfig(RecomputeStatsConfig(overwrite=True), NAME, root=str(merged), new_root=str(merged)))
    stats = json.loads((merged / "meta" / "stats.json").read_text())
    assert {"q01", "q99"} <= set(stats["action"])
    assert calibration_of(merged) != {}


def test_datasets_of_two_rigs_are_not_merged_as_one(recorded, merged, folder):
    """LeRobot compares a feature's `info`, so a calibration that differs stops it."""
    other = folder / "parts" / "rest" / "meta" / "info.json"
    info = json.loads(other.read_text())
    info["features"][DEPTH]["info"]["calibration"]["intrinsics"][0] += 1.0
    other.write_text(json.dumps(info))
    parts = [str(folder / "parts" / name) for name in ("first", "rest")]
    with pytest.raises(ValueError, match="Same features is expected"):
        edit_dataset(
            EditDatasetConfig(
                MergeConfig(repo_ids=[f"{NAME}_first", f"{NAME}_rest"], roots=parts),
                new_repo_id=NAME,
                new_root=str(folder / "two-rigs"),
            )
        )


@pytest.mark.train
def test_training_reads_poses_and_calibration_of_an_edited_dataset(merged, folder):
    """The base frame needs both: without either this would be refused."""
    lerobot("train", *arguments(merged, folder / "run", steps=2))
    config = json.loads((folder / "run/checkpoints/last/pretrained_model/config.json").read_text())
    assert config["geometry_frame"] == "base"
    assert config["calibration"]["front"]["intrinsics"] == calibration_of(merged)["front"].intrinsics
    assert config["geometry_features"][POSE]["shape"] == [16]
