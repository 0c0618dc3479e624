"""Samples from memory are LeRobot's, bit for bit."""

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_pi05_geometry.sim.record import record
from lerobot_policy_pi05_geometry.study.frames_in_memory import FramesInMemory
from lerobot_policy_pi05_geometry.study.training import train_with

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "frames"
    list(record(folder, "local/frames", "button-press-topdown-wide", episodes=3, image_size=28))
    return folder


@pytest.mark.parametrize("episodes", [None, [0, 2]])
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_every_sample_equals_lerobots(root, episodes, unit):
    """Chunks that run over an episode's end and episodes that were left out included."""
    settings = {"episodes": episodes, "return_uint8": True, "depth_output_unit": unit}
    dataset = LeRobotDataset(
        "local/frames", root=root, delta_timestamps={"action": [i / 20 for i in range(6)]}, **settings
    )
    frames = FramesInMemory(dataset)
    assert len(frames) == len(dataset)
    for index in [*range(0, len(dataset), 3), len(dataset) - 1]:
        expected, found = dataset[index], frames[index]
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            same = torch.equal(found[key], value) if isinstance(value, torch.Tensor) else found[key] == value
            assert same, (index, key)


def test_observation_histories_are_refused(root):
    dataset = LeRobotDataset("local/frames", root=root, delta_timestamps={"observation.state": [-0.05, 0.0]})
    with pytest.raises(ValueError, match="use lerobot-train"):
        FramesInMemory(dataset)


def training(root, output, *more):
    return [
        "--policy.type=pi05_geometry", "--policy.geometry_source=none", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.paligemma_variant=tiny", "--policy.action_expert_variant=tiny", "--policy.image_resolution=[28, 28]",
        "--policy.chunk_size=4", "--policy.n_action_steps=4", "--dataset.repo_id=local/frames", f"--dataset.root={root}",
        f"--output_dir={output}", "--batch_size=2", "--steps=2", "--num_workers=0", *more,
    ]  # fmt: skip


@pytest.mark.train
def test_transformed_images_are_read_from_disk_and_streamed_ones_refused(root, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["train"])  # training sets them
    train_with(training(root, tmp_path / "run", "--dataset.image_transforms.enable=true"))
    assert (tmp_path / "run/checkpoints/last/pretrained_model/model.safetensors").exists()
    with pytest.raises(ValueError, match=r"leave --dataset.streaming out"):
        train_with(training(root, tmp_path / "other", "--dataset.streaming=true"))
