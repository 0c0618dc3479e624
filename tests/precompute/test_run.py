"""A store is the same to the byte, however often it was killed and whoever shared the work."""

import dataclasses
import errno
import os
import random
import shutil
import signal
import time
from collections import namedtuple

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_pi05_geometry.geometry.feature_store import FeatureStore
from lerobot_policy_pi05_geometry.geometry.feature_store.shards import ShardWriter
from lerobot_policy_pi05_geometry.precompute import Precompute, begin, disk_needed, prepare
from tests.datasets import REPO_ID, write_dataset
from tests.geometry.da3.tiny import write_tiny
from tests.geometry.feature_store.test_shards import files
from tests.geometry.test_depth_names import NAME
from tests.geometry.test_depth_names import write_dataset as write_depth_dataset

BATCH = 2
FRAMES = 26


class Counting:
    """The source, noting every batch that it is asked for."""

    def __init__(self, source, note):
        self._source, self._note = source, note

    def __call__(self, batch):
        self._note()
        return self._source(batch)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> LeRobotDataset:
    return LeRobotDataset(REPO_ID, root=write_dataset(tmp_path_factory.mktemp("data") / "tiny"), return_uint8=True)


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory) -> Precompute:
    """A store made in one go, seven frames a file: the last batch of a file is cut short by its end."""
    folder = tmp_path_factory.mktemp("whole")
    encoder = write_tiny(folder / "encoder" / "model.safetensors").parent
    work = prepare(dataset, str(encoder), 3, image_size=42, output=folder / "stores", shard_frames=7)
    begin(work)
    work.run(BATCH)
    return work


def elsewhere(work: Precompute, stores) -> Precompute:
    """The same work, with nothing done."""
    return dataclasses.replace(work, folder=stores / work.folder.name)


def test_features_are_those_of_the_live_source_in_bfloat16(whole, dataset):
    store = FeatureStore(whole.folder)
    for index in (0, 8, 9, FRAMES - 1):
        images = {key: dataset[index][key][None] for key in whole.manifest.cameras.values()}
        live = whole.source(images).features
        torch.testing.assert_close(store.read([index]).float(), live, rtol=2**-7, atol=2e-3)
    assert (store.read([0]).float() - store.read([1]).float()).abs().max() > 0.5


@pytest.mark.parametrize("key", ["observation.depth_front", "observation.images.depth.front"])
def test_depth_under_another_name_is_no_rgb_camera(key, tmp_path):
    data = LeRobotDataset(NAME, root=write_depth_dataset(tmp_path / "data", key), return_uint8=True)
    encoder = write_tiny(tmp_path / "encoder" / "model.safetensors").parent
    work = prepare(data, str(encoder), 3, image_size=42, output=tmp_path / "stores")
    assert work.manifest.cameras == {"front": "observation.images.front"}
    begin(work)
    work.run(BATCH)


def test_the_work_of_two_ranks_is_the_work_of_one(whole, tmp_path):
    work, told = elsewhere(whole, tmp_path), []
    for rank in (1, 0):
        begin(work)
        mine = work.missing(rank, 2)
        work.run(BATCH, rank=rank, world_size=2, on_progress=lambda frames, _: told.append(frames))
        assert not work.missing(rank, 2)
        assert mine == [shard for shard in range(4) if shard % 2 == rank]
    assert sum(told) == FRAMES
    assert files(work.folder) == files(whole.folder)


@pytest.mark.parametrize("seed", range(3))
def test_stopped_at_any_batch_it_goes_on_with_that_batch(whole, tmp_path, seed):
    draw, asked, stops = random.Random(seed), [0], 0
    work = elsewhere(whole, tmp_path)

    def note():
        asked[0] += 1
        if draw.random() < 0.3:
            raise KeyboardInterrupt

    work = dataclasses.replace(work, source=Counting(whole.source, note))
    while True:
        begin(work)
        try:
            work.run(BATCH)
            break
        except KeyboardInterrupt:
            stops += 1
    assert stops > 1
    assert asked[0] == 4 + 4 + 4 + 3 + stops
    assert files(work.folder) == files(whole.folder)


def start(work: Precompute, log: int) -> int:
    """Do the work in a process of its own, which writes a byte for every batch it begins; returns its id."""
    process = os.fork()
    if process == 0:
        code = 1
        try:
            noting = dataclasses.replace(work, source=Counting(work.source, lambda: os.write(log, b".")))
            begin(noting)
            noting.run(BATCH)
            code = 0
        finally:
            os._exit(code)
    return process


@pytest.mark.slow
def test_killed_at_twenty_random_moments_nothing_is_lost_or_computed_twice(whole, tmp_path):
    draw, expected = random.Random(0), files(whole.folder)
    log = os.open(tmp_path / "log", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    work = elsewhere(whole, tmp_path)
    begun = time.monotonic()
    assert os.waitpid(start(work, log), 0)[1] == 0
    duration, batches = time.monotonic() - begun, os.fstat(log).st_size
    kills, kills_of_store, finished = 0, 0, 0
    shutil.rmtree(work.folder)
    os.ftruncate(log, 0)
    while kills < 20 or work.missing():
        process = start(work, log)
        if kills < 20:
            time.sleep(draw.uniform(0, duration / 2))
            os.kill(process, signal.SIGKILL)
        status = os.waitpid(process, 0)[1]
        if os.WIFSIGNALED(status):
            assert os.WTERMSIG(status) == signal.SIGKILL
            kills, kills_of_store = kills + 1, kills_of_store + 1
        else:
            assert os.waitstatus_to_exitcode(status) == 0
            assert files(work.folder) == expected
            assert os.fstat(log).st_size <= batches + kills_of_store
            finished += 1
            if kills < 20:
                shutil.rmtree(work.folder)
                os.ftruncate(log, 0)
                kills_of_store = 0
    assert finished
    assert files(work.folder) == expected
    os.close(log)


@pytest.mark.slow
def test_two_processes_at_once_do_not_disturb_each_other(whole, tmp_path):
    """Not told of each other, they share the work by the locks on its files."""
    log = os.open(tmp_path / "log", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    work = elsewhere(whole, tmp_path)
    for process in [start(work, log) for _ in range(2)]:
        assert os.waitpid(process, 0)[1] == 0
    assert files(work.folder) == files(whole.folder)
    assert os.fstat(log).st_size == 4 + 4 + 4 + 3
    os.close(log)


# --- refused ------------------------------------------------------------------------------------------------------


def test_a_disk_that_cannot_hold_it_is_said_before_it_starts(whole, tmp_path, monkeypatch):
    work = elsewhere(whole, tmp_path)
    needed = FRAMES * work.manifest.record_bytes
    assert disk_needed(work) == needed
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(0, 0, needed - 1))
    with pytest.raises(OSError, match=r"cannot hold the features: 0.0 GB are needed and 0.0 GB are free; make room"):
        begin(work)
    assert not work.folder.exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(0, 0, needed))
    begin(work)
    work.run(BATCH, rank=0, world_size=2)
    assert disk_needed(work) == 7 * work.manifest.record_bytes + 5 * work.manifest.record_bytes


def test_a_disk_that_fills_up_loses_nothing(whole, tmp_path, monkeypatch):
    work, append, calls = elsewhere(whole, tmp_path), ShardWriter.append, [0]

    def fail(self, features):
        calls[0] += 1
        if calls[0] == 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, features)

    begin(work)
    monkeypatch.setattr(ShardWriter, "append", fail)
    with pytest.raises(OSError, match=r"is full; what is computed is kept, so make room and run this again"):
        work.run(BATCH)
    told = []
    work.run(BATCH, on_progress=lambda frames, found: told.append((frames, found)))
    assert told[0] == (2, True)
    assert files(work.folder) == files(whole.folder)


def test_a_store_begun_with_files_of_another_length(whole, dataset):
    with pytest.raises(ValueError, match=r"begun with 7 frames per file, not 8; continue with --shard-frames=7"):
        prepare(dataset, whole.manifest.encoder, 3, image_size=42, output=whole.folder.parent, shard_frames=8)


def test_a_manifest_cannot_send_the_features_elsewhere(whole, dataset, tmp_path):
    """It comes with the dataset. The store that goes on is the one that was found."""
    folder = tmp_path / "stores" / "found"
    shutil.copytree(whole.folder, folder)
    dataclasses.replace(whole.manifest, key="../../victim").write(folder)
    again = prepare(dataset, whole.manifest.encoder, 3, image_size=42, output=folder.parent, shard_frames=7)
    assert again.folder == folder


def test_settings_that_cannot_be(dataset, whole, tmp_path):
    encoder = whole.manifest.encoder
    with pytest.raises(ValueError, match="geometry_cameras names back, but the data has RGB images from front, wrist"):
        prepare(dataset, encoder, 3, cameras=["back"])
    with pytest.raises(ValueError, match="da3_image_size must be a multiple of 42"):
        prepare(dataset, encoder, 3, image_size=40)
    with pytest.raises(FileNotFoundError, match="encoder is not found"):
        prepare(dataset, str(tmp_path / "nowhere"), 3)
    with pytest.raises(ValueError, match="--batch-size must be at least 1"):
        whole.run(0)
