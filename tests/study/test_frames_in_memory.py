"""Samples from memory are LeRobot's, bit for bit."""

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_pi05_geometry.sim.record import record
from lerobot_policy_pi05_geometry.study.frames_in_memory import FramesInMemory

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
