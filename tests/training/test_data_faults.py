"""lerobot-train itself, in this process: a value that is no number stops it, and relative actions can be switched on."""

import json
import math
import sys
from pathlib import Path

import pyarrow
import pytest
import torch
from lerobot.datasets.dataset_tools import recompute_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from pyarrow import parquet
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from tests.datasets import REPO_ID, write_dataset
from tests.entry_points import FRONT, STATE, WRIST, make_config, make_features, make_stats

pytestmark = pytest.mark.train


@pytest.fixture
def dataset(tmp_path) -> Path:
    return write_dataset(tmp_path / "data")


@pytest.fixture
def train(dataset, tmp_path, monkeypatch):
    """Runs lerobot-train on the dataset from a tiny checkpoint; returns the folder of checkpoints."""
    inputs, outputs = make_features()
    inputs = {key: inputs[key] for key in (FRONT, WRIST, STATE)}
    config = make_config(geometry_source="none", calibration={}, input_features=inputs, output_features=outputs)
    PI05GeometryPolicy(config).save_pretrained(tmp_path / "start")
    for pipeline in make_pi05_geometry_pre_post_processors(config, make_stats()):
        pipeline.save_pretrained(tmp_path / "start")

    def run(*options: str) -> Path:
        from lerobot.scripts import lerobot_train

        arguments = [
            f"--policy.path={tmp_path / 'start'}", "--policy.device=cpu", "--policy.push_to_hub=false",
            f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}", f"--output_dir={tmp_path / 'run'}",
            "--save_freq=1", "--batch_size=2", "--num_workers=0", "--wandb.enable=false", *options,
        ]  # fmt: skip
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
        monkeypatch.setattr(lerobot_train, "init_logging", lambda **_: None)  # it would take the loggers from pytest
        lerobot_train.train()
        return tmp_path / "run" / "checkpoints"

    return run


def test_a_frame_that_is_no_number_stops_training_and_the_last_checkpoint_is_good(dataset, train, tmp_path):
    (file,) = (dataset / "data").rglob("*.parquet")
    table = parquet.read_table(file)
    actions = table["action"].to_pylist()
    actions[19][3] = math.nan
    column = table.column_names.index("action")
    parquet.write_table(
        table.set_column(column, table.field(column), pyarrow.array(actions, table["action"].type)), file
    )
    with pytest.raises(ValueError, match=r"action\[3\] is nan, \d frames after the frame with dataset index 1[4-9]"):
        train("--steps=40")
    saved = load_file(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")
    assert saved["progress.step"] > 0
    assert all(tensor.isfinite().all() for tensor in saved.values())


def test_relative_actions_are_switched_on_in_a_checkpoint_that_was_trained_without(dataset, train):
    recompute_stats(
        LeRobotDataset(REPO_ID, root=dataset), relative_action=True, relative_exclude_joints=[], chunk_size=6
    )
    folder = train("--steps=1", "--policy.use_relative_actions=true", "--policy.relative_exclude_joints=[]")
    checkpoint = folder / "last" / "pretrained_model"
    assert json.loads((checkpoint / "config.json").read_text())["use_relative_actions"]
    loaded = load_policy(checkpoint)
    torch.manual_seed(0)
    frames = LeRobotDataset(REPO_ID, root=dataset)
    seen = [frames[0], frames[7]]
    sent = []
    for frame in seen:
        batch = loaded.preprocess({key: frame[key] for key in (FRONT, WRIST, STATE, "task")})
        sent.append(loaded.postprocess(loaded.policy.select_action(batch)))
    loaded.policy.reset()
    torch.manual_seed(0)
    batch = loaded.preprocess({key: seen[0][key] for key in (FRONT, WRIST, STATE, "task")})
    chunk = loaded.postprocess(loaded.policy.predict_action_chunk(batch))
    assert torch.equal(torch.stack(sent, dim=1), chunk[:, :2])
