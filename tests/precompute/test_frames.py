"""The images that precompute sees are those that training sees."""

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_pi05_geometry.precompute.frames import Frames
from tests.datasets import REPO_ID, write_dataset

KEYS = ["observation.images.wrist", "observation.images.front"]


@pytest.mark.parametrize("videos", [False, True], ids=["images", "videos"])
def test_every_frame_equals_lerobots(tmp_path, videos):
    root = write_dataset(tmp_path / "data", videos=videos)
    dataset = LeRobotDataset(REPO_ID, root=root, return_uint8=True)
    batches = [range(0, 7), range(7, 20), range(20, 26)]  # over the ends of episodes
    found = dict(Frames(dataset, KEYS).read_ahead(batches))
    assert list(found) == batches
    for batch, images in found.items():
        assert list(images) == KEYS
        for key, image in images.items():
            assert torch.equal(image, torch.stack([dataset[i][key] for i in batch])), (batch, key)
    if not videos:
        with pytest.raises(ValueError, match=r"lacks frame 26: .* 0 to 25 in order"):
            Frames(dataset, KEYS).read(range(24, 28))
        part = LeRobotDataset(REPO_ID, root=root, episodes=[0, 2], return_uint8=True)
        with pytest.raises(ValueError, match=r"lacks frame 9:"):
            Frames(part, KEYS).read(range(8, 11))
