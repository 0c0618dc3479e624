"""A store's files: whatever is cut off or changed is found, and what was written is read back."""

import shutil
from collections import namedtuple
from pathlib import Path

import psutil
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.feature_store import FeatureStore, Manifest, read_manifest
from lerobot_policy_pi05_geometry.geometry.feature_store.fingerprint import Episodes
from lerobot_policy_pi05_geometry.geometry.feature_store.manifest import stores_in
from lerobot_policy_pi05_geometry.geometry.feature_store.shards import ShardWriter, writing


def make_manifest(frames=13, shard_frames=5, views=2, grid=2, width=3, episode="1" * 16, **changes) -> Manifest:
    settings = {
        "encoder": "some/encoder",
        "encoder_hash": "0" * 64,
        "image_size": 28,
        "dtype": "bfloat16",
        "grid": grid,
        "cameras": {f"camera{i}": f"observation.images.camera{i}" for i in range(views)},
        "feature_dim": width,
        "dataset_files": {"data/a.parquet": 10},
        "shard_frames": shard_frames,
    }
    return Manifest.new(Episodes([frames], [episode]), **{**settings, **changes})


def make_features(manifest: Manifest, seed=0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(manifest.frames, *manifest.shape, generator=generator).bfloat16()


def write_store(parent, manifest=None, features=None, batch=2):
    """A finished store; returns its folder."""
    manifest = manifest or make_manifest()
    features = make_features(manifest) if features is None else features
    folder = parent / manifest.key
    folder.mkdir(parents=True, exist_ok=True)
    manifest.write(folder)
    for shard in range(manifest.shards):
        with writing(folder, manifest, shard, batch) as writer:
            if writer is not None:
                for frames in writer.batches():
                    writer.append(features[frames.start : frames.stop].float())
                writer.finish()
    return folder


def files(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@given(st.integers(1, 12), st.integers(1, 6), st.integers(1, 3), st.integers(1, 3), st.integers(1, 5), st.randoms())
def test_what_is_written_is_read_in_any_order(tmp_path_factory, frames, shard_frames, views, grid, width, random):
    manifest = make_manifest(frames, shard_frames, views, grid, width)
    features = make_features(manifest)
    store = FeatureStore(write_store(tmp_path_factory.mktemp("store"), manifest, features))
    indices = [random.randrange(frames) for _ in range(9)]
    assert torch.equal(store.read(indices), features[indices])
    assert sum(store.verify()) == frames * manifest.record_bytes
    assert read_manifest(store.folder) == manifest


def test_the_key_is_of_what_features_depend_on():
    key = make_manifest().key
    same = {"encoder": "elsewhere", "shard_frames": 7}
    other = {
        "encoder_hash": "2" * 64,
        "image_size": 42,
        "dtype": "float32",
        "grid": 3,
        "episode": "3" * 16,
        "frames": 14,
        "width": 4,
        "dataset_files": {"data/a.parquet": 11},
        "cameras": dict(reversed(make_manifest().cameras.items())),  # another reference view
    }
    for name, value in same.items():
        assert make_manifest(**{name: value}).key == key, name
    for name, value in other.items():
        assert make_manifest(**{name: value}).key != key, name


@given(st.integers(1, 12), st.integers(1, 6), st.lists(st.integers(1, 9), max_size=3), st.randoms())
def test_a_store_that_grows_keeps_its_files_and_its_frames(tmp_path_factory, frames, shard_frames, more, random):
    folder, manifest = tmp_path_factory.mktemp("store"), make_manifest(frames, shard_frames)
    every = torch.randn(frames + sum(more), *manifest.shape).bfloat16()
    write_store(folder, manifest, every)
    for count in more:
        before = {name: content for name, content in files(folder / manifest.key).items() if name.startswith("shard")}
        old = manifest.episodes
        episodes = Episodes([*old.frames, count], [*old.hashes, f"{len(old.hashes):016d}"])
        grown = manifest.extended(episodes, {"data/a.parquet": 10, "data/b.parquet": 5})
        assert grown.key == manifest.key
        write_store(folder, grown, every)
        after = files(folder / grown.key)
        assert {name: after[name] for name in before} == before
        manifest = grown
    store = FeatureStore(folder / manifest.key)
    indices = [random.randrange(manifest.frames) for _ in range(9)]
    assert torch.equal(store.read(indices), every[indices])
    assert sum(store.verify()) == len(every) * manifest.record_bytes
    assert [i for shard in range(manifest.shards) for i in manifest.frames_of(shard)] == list(range(len(every)))
    assert read_manifest(store.folder) == manifest
    assert manifest.extended(manifest.episodes, manifest.dataset_files) == manifest


def test_the_whole_store_is_read_ahead_if_memory_can_hold_it(tmp_path, monkeypatch):
    def bytes_read() -> int:
        return int(Path("/proc/self/io").read_text().split()[1])

    manifest = make_manifest(frames=2500, shard_frames=1000, grid=6, width=16)
    store = FeatureStore(write_store(tmp_path, manifest, batch=1000))
    size, before = sum(manifest.shard_bytes(shard) for shard in range(3)), bytes_read()
    store.read_ahead().join()
    assert size <= bytes_read() - before < 1.1 * size
    memory = namedtuple("memory", "available")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory(2 * size))
    assert store.read_ahead() is not None
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory(2 * size - 1))
    assert store.read_ahead() is None


# --- interrupted --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [1, 2, 3, 5, 8])
def test_cut_off_anywhere_it_goes_on_to_the_same_bytes(tmp_path, batch):
    """After a crash a file may end anywhere, or, after one of the machine, in zeros or rubbish."""
    manifest = make_manifest()
    features = make_features(manifest)
    expected = files(write_store(tmp_path / "whole", manifest, features, batch))
    whole = expected["shard-00001.bin"]
    for i, length in enumerate(range(0, len(whole) + 1, 17)):
        for tail in (b"", bytes(90), b"rubbish"):
            folder = tmp_path / f"{i}-{len(tail)}" / manifest.key
            folder.mkdir(parents=True)
            (folder / "shard-00001.partial").write_bytes(whole[:length] + tail)
            (folder / ".shard-00001.sha256.unfinished").write_text("half a li")
            writer = ShardWriter(folder, manifest, 1, batch)
            good = min(length // manifest.record_bytes, 5)
            assert good - writer.done < batch
            assert writer.done == 5 or writer.done % batch == 0
            write_store(folder.parent, manifest, features, batch)
            assert files(folder) == expected


def test_a_shard_that_is_being_written_is_left_alone(tmp_path):
    manifest = make_manifest()
    (tmp_path / manifest.key).mkdir()
    with writing(tmp_path / manifest.key, manifest, 0, 2) as writer:
        assert writer is not None
        with writing(tmp_path / manifest.key, manifest, 0, 2) as second:
            assert second is None


# --- refused ------------------------------------------------------------------------------------------------------


@given(st.integers(0, 2), st.integers(0, 10**6), st.integers(1, 255))
def test_a_changed_byte_is_found_when_its_frame_is_read_and_by_verify(tmp_path_factory, shard, place, change):
    manifest = make_manifest()
    folder = write_store(tmp_path_factory.mktemp("store"), manifest)
    path = folder / f"shard-{shard:05d}.bin"
    content = bytearray(path.read_bytes())
    place %= len(content)
    content[place] ^= change
    path.write_bytes(content)
    store, frame = FeatureStore(folder), 5 * shard + place // manifest.record_bytes
    others = [i for i in range(manifest.frames) if i != frame]
    assert torch.equal(store.read(others), make_features(manifest)[others])
    with pytest.raises(ValueError, match=rf"^Store file {path} is damaged at frame {frame}: .* delete it and run"):
        store.read([frame])
    with pytest.raises(ValueError, match=rf"^Store file {path} is damaged: it is not what .*\.sha256 says; delete"):
        list(store.verify())


def test_a_damaged_file_that_was_deleted_is_computed_again_alone(tmp_path):
    folder = write_store(tmp_path)
    expected = files(folder)
    for name in ("shard-00001.bin", "shard-00002.sha256"):
        (folder / name).unlink()
    with pytest.raises(
        FileNotFoundError, match=r"not finished: 1 of 3 files are missing, beginning with shard-00001.bin"
    ):
        FeatureStore(folder)
    write_store(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"shard-00002.sha256 is missing"):
        list(FeatureStore(folder).verify())
    (folder / "shard-00002.bin").unlink()
    write_store(tmp_path)
    assert files(folder) == expected


def test_files_that_do_not_belong_are_refused(tmp_path):
    """A file cut short, one under another number, and one of another store with the same shapes."""
    folder, other = write_store(tmp_path / "a"), write_store(tmp_path / "b", make_manifest(encoder_hash="4" * 64))
    (folder / "shard-00002.bin").write_bytes((folder / "shard-00002.bin").read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"shard-00002.bin is damaged: expected \d+ bytes, found \d+; delete it"):
        FeatureStore(folder)
    shutil.copy(other / "shard-00002.bin", folder)
    with pytest.raises(ValueError, match="damaged at frame 10"):
        FeatureStore(folder).read([10])
    shutil.copy(folder / "shard-00000.bin", folder / "shard-00001.bin")
    with pytest.raises(ValueError, match="damaged at frame 5"):
        FeatureStore(folder).read([5])


@pytest.mark.parametrize("index", [-1, 13, 10_000])
def test_a_frame_that_the_store_does_not_have(tmp_path, index):
    with pytest.raises(
        ValueError, match=rf"has no frame {index} \(it has 0 to 12\): the batch is not from the dataset"
    ):
        FeatureStore(write_store(tmp_path)).read([index])


def test_a_manifest_that_is_none(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no feature store \(manifest.json is missing\); make one with"):
        read_manifest(tmp_path)
    folder = write_store(tmp_path)
    text = (folder / "manifest.json").read_text()
    for broken in (text[:50], "[1]", text.replace('"parts"', '"pieces"')):
        (folder / "manifest.json").write_text(broken)
        with pytest.raises(ValueError, match=r"manifest.json is damaged"):
            read_manifest(folder)
    (folder / "manifest.json").write_text(text.replace('"grid": 2', '"grid": 1'))
    with pytest.raises(ValueError, match=r"was changed by hand"):
        read_manifest(folder)
    (folder / "manifest.json").write_text(text.replace('"format": 2', '"format": 1'))
    with pytest.raises(ValueError, match=r"has format 1, this version reads 2; run pi05-geometry precompute again"):
        read_manifest(folder)
    assert stores_in(tmp_path) == {}
