"""A dataset that changed where it matters is another one; one that grew begins as it did."""

import shutil

import pytest
from lerobot.datasets.dataset_tools import modify_tasks
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_pi05_geometry.data.quantiles import write_frame_quantiles
from lerobot_policy_pi05_geometry.geometry.feature_store.fingerprint import changed_file, frame_files, read_episodes
from tests.datasets import REPO_ID, add_episodes, write_dataset


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "tiny", (4, 3))


@pytest.fixture
def root(original, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(original, tmp_path / "data")


def test_episodes_are_told_apart_by_their_length_and_statistics(original, root, tmp_path):
    before = read_episodes(original)
    assert before.frames == [4, 3]
    assert len(set(before.hashes)) == 2
    assert read_episodes(root) == before
    write_frame_quantiles(root, REPO_ID, ("observation.state", "action"))
    (root / "meta" / "info.json").write_text((root / "meta" / "info.json").read_text() + " ")
    modify_tasks(LeRobotDataset(REPO_ID, root=root), new_task="pull")
    assert read_episodes(root) == before, "features depend on none of these"
    assert read_episodes(write_dataset(tmp_path / "other", (4, 3), seed=1)).hashes != before.hashes


def test_a_dataset_that_grew_begins_as_it_did(original, root):
    before = read_episodes(original)
    add_episodes(root, (2, 5))
    after = read_episodes(root)
    assert after.frames == [4, 3, 2, 5]
    assert after.begins_with(before)
    assert not before.begins_with(after)
    assert changed_file(root, frame_files(original), allow_new=True) is None
    assert "file-001" in changed_file(root, frame_files(original), allow_new=False)


def test_a_file_of_frames_that_changed_is_named(root):
    recorded = frame_files(root)
    assert list(recorded) == ["data/chunk-000/file-000.parquet"]
    assert changed_file(root, recorded, allow_new=False) is None
    (data,) = (root / "data").rglob("*.parquet")
    content = data.read_bytes()
    data.unlink()  # a partial download
    assert changed_file(root, recorded, allow_new=False) is None
    data.write_bytes(content + b" ")
    for allow_new in (True, False):
        assert changed_file(root, recorded, allow_new) == "data/chunk-000/file-000.parquet"


def test_no_dataset(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no LeRobotDataset"):
        read_episodes(tmp_path)
