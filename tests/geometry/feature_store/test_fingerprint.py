"""A dataset that changed where it matters is another one."""

import shutil

import pytest

from lerobot_policy_pi05_geometry.geometry.feature_store.fingerprint import changed_file, dataset_hash, frame_files


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "dataset"
    for name in ("meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet",
                 "meta/episodes/chunk-000/file-001.parquet", "data/chunk-000/file-000.parquet",
                 "videos/observation.images.front/chunk-000/file-000.mp4"):  # fmt: skip
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"content of {name}")
    return folder


def test_the_hash_is_of_the_tables_that_say_where_frames_are(root, tmp_path):
    before = dataset_hash(root)
    assert dataset_hash(shutil.copytree(root, tmp_path / "copy")) == before
    for name in (
        "meta/stats.json",
        "meta/tasks.parquet",
        "data/chunk-000/file-000.parquet",
        "geometry/a/manifest.json",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("changed")
        assert dataset_hash(root) == before, name
    found = {before}
    for name in ("meta/info.json", "meta/episodes/chunk-000/file-001.parquet"):
        (root / name).write_text("changed")
        found.add(dataset_hash(root))
    (root / "meta/episodes/chunk-000/file-001.parquet").rename(root / "meta/episodes/chunk-000/file-002.parquet")
    found.add(dataset_hash(root))
    assert len(found) == 4


def test_a_file_of_frames_that_changed_is_named(root):
    recorded = frame_files(root)
    assert list(recorded) == [
        "data/chunk-000/file-000.parquet",
        "videos/observation.images.front/chunk-000/file-000.mp4",
    ]
    assert changed_file(root, recorded) is None
    (root / "data/chunk-000/file-000.parquet").unlink()  # a partial download
    assert changed_file(root, recorded) is None
    video = "videos/observation.images.front/chunk-000/file-000.mp4"
    (root / video).write_text("changed")
    assert changed_file(root, recorded) == video


def test_no_dataset(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no LeRobotDataset"):
        dataset_hash(tmp_path)
