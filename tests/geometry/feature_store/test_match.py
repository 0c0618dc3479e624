"""A policy that trains from a feature store: what it reads, what it refuses, and that it acts the same live."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.transforms import ImageTransformsConfig

from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.precompute import begin, prepare
from lerobot_policy_pi05_geometry.precompute.augmentation import refuse_augmentation
from tests.datasets import REPO_ID, add_episodes, write_dataset
from tests.entry_points import FRONT, GEOMETRY, WRIST, chunk_of, make_batch, make_config, redraw, without
from tests.geometry.da3.tiny import write_tiny
from tests.geometry.feature_store.test_shards import files

INDICES = (17, 0, 9, 25)

# Features are stored in bfloat16, at most 2^-9 of themselves from what the encoder gave. What that may do to an action, in
# standard deviations of the actions; in a bfloat16 network every difference is rounded up to its own steps.
TOLERANCES = {"float32": 0.001, "bfloat16": 0.01}


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    """A dataset with a finished store, and its encoder beside it."""
    folder = tmp_path_factory.mktemp("stored")
    root = write_dataset(folder / "data")
    write_tiny(folder / "encoder" / "model.safetensors")
    compute(root, folder / "encoder")
    return root


@pytest.fixture
def root(original, tmp_path) -> Path:
    """A copy that a test may spoil."""
    return shutil.copytree(original, tmp_path / "data")


def compute(root: Path, encoder: Path, **settings) -> Path:
    """Make a store as `pi05-geometry precompute` does; returns its folder."""
    dataset = LeRobotDataset(REPO_ID, root=root, return_uint8=True)
    work = prepare(dataset, str(encoder), **{"grid": 3, "image_size": 42, "shard_frames": 10, **settings})
    begin(work)
    work.run(4)
    return work.folder


def store_of(root: Path) -> Path:
    (manifest,) = (root / "geometry").glob("*/manifest.json")
    return manifest.parent


def make_stored(root: Path | None, **changes) -> PI05GeometryPolicy:
    """A policy as LeRobot makes it for a dataset."""
    torch.manual_seed(0)
    config = make_config(**{"geometry_source": "features", "calibration": {}, **changes})
    meta = None if root is None else SimpleNamespace(root=root)
    return redraw(PI05GeometryPolicy(config, dataset_meta=meta)).eval()


def frames_of(root: Path, indices=INDICES) -> dict:
    """A batch of these frames of the dataset, as the preprocessor hands it to the policy."""
    dataset = LeRobotDataset(REPO_ID, root=root, return_uint8=True)
    batch = without(make_batch(len(indices)), *GEOMETRY)
    for key in (FRONT, WRIST):
        batch[key] = torch.stack([dataset[i][key] for i in indices])
    return batch | {"index": torch.tensor(indices)}


def test_training_needs_no_encoder_and_no_look_at_the_images(root, original):
    shutil.move(original.parent / "encoder", original.parent / "away")
    try:
        policy, batch = make_stored(root, geometry_dropout=0.0, image_dropout=0.0).train(), frames_of(root)
        found = policy.geometry.source(batch)
        assert found.valid.all()
        assert torch.equal(policy.geometry.source(batch | {FRONT: 0 * batch[FRONT]}).features, found.features)
        loss, _ = policy.forward(batch)
        loss.backward()
        assert all(p.grad is not None for p in policy.geometry.parameters())
        assert not any(name.startswith("geometry.source") for name in policy.state_dict())
        other, _ = policy.forward(batch | {"index": torch.tensor([1, 2, 3, 4])})
        assert other != loss
    finally:
        shutil.move(original.parent / "away", original.parent / "encoder")


@pytest.mark.parametrize("dtype", list(TOLERANCES))
def test_actions_from_the_store_are_those_from_the_live_encoder(root, tmp_path, dtype):
    """Loaded without a dataset, as lerobot-eval and lerobot-rollout do, the checkpoint sees through the encoder."""
    policy, batch = make_stored(root, dtype=dtype, param_dtype=dtype), frames_of(root)
    policy.save_pretrained(tmp_path / "checkpoint")
    live = PI05GeometryPolicy.from_pretrained(tmp_path / "checkpoint")
    assert live.config.da3_hash is not None
    stored = chunk_of(policy, batch)
    seen = chunk_of(live, without(batch, "index"))
    wrong = chunk_of(policy, batch | {"index": (batch["index"] + 1) % 26})
    tolerance = TOLERANCES[dtype] * stored.float().std()
    assert (stored - seen).abs().max() < tolerance
    assert (stored - wrong).abs().max() > tolerance
    torch.testing.assert_close(
        policy.geometry.source(batch).features, live.geometry.source(batch).features, rtol=2**-7, atol=5e-3
    )
    # An environment that lerobot-train evaluates in, inside of training, has no index either.
    assert torch.equal(chunk_of(policy, without(batch, "index")), seen)
    assert torch.equal(chunk_of(policy, batch), stored)


def test_a_camera_that_fails_on_the_robot_is_masked_as_with_da3(root, tmp_path):
    policy, batch = make_stored(root), without(frames_of(root), "index")
    policy.save_pretrained(tmp_path / "checkpoint")
    live = PI05GeometryPolicy.from_pretrained(tmp_path / "checkpoint")
    for acting in (policy, live):
        acting._measure(batch)
        _, pad = acting._measure(without(batch, WRIST))
        assert pad.unflatten(1, (2, 9)).all(dim=2).tolist() == [[True, False]] * len(INDICES)


def test_training_goes_on_from_a_checkpoint(root, tmp_path):
    """As --resume and --policy.path do: with a dataset; the store may have moved."""
    policy, batch = make_stored(root), frames_of(root)
    policy.save_pretrained(tmp_path / "checkpoint")
    expected = chunk_of(policy, batch)
    moved = root.rename(root.with_name("moved"))
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path / "checkpoint", dataset_meta=SimpleNamespace(root=moved))
    assert loaded.config == policy.config
    assert torch.equal(chunk_of(loaded, batch), expected)


def test_what_was_trained_live_goes_on_from_the_store(root, original):
    """A policy of geometry_source=da3 has its encoder's hash already."""
    encoder = str(original.parent / "encoder")
    trained = {"da3_encoder": encoder, "da3_image_size": 42}
    live = make_stored(None, geometry_source="da3", **trained)
    stored = make_stored(root, da3_hash=live.config.da3_hash, **trained)
    assert stored.config.da3_hash == live.config.da3_hash
    with pytest.raises(
        ValueError, match=r"another encoder: .* the policy's is .*\(SHA-256 9+\); run pi05-geometry precompute"
    ):
        make_stored(root, da3_hash="9" * 64, **trained)
    with pytest.raises(ValueError, match=r"computed with da3_image_size 42, the policy has 210"):
        make_stored(root, da3_hash=live.config.da3_hash, da3_encoder=encoder)  # the default size for a grid of 3


# --- refused ------------------------------------------------------------------------------------------------------


def test_no_store(root, tmp_path):
    shutil.rmtree(root / "geometry")
    with pytest.raises(
        FileNotFoundError, match=rf"{root / 'geometry'} has none; run pi05-geometry precompute --dataset.root"
    ):
        make_stored(root)
    with pytest.raises(FileNotFoundError, match=r"is no feature store \(manifest.json is missing\)"):
        make_stored(root, features_path=str(tmp_path))
    with pytest.raises(ValueError, match="there is no dataset to train on; use geometry_source=da3"):
        make_stored(None)


def test_a_changed_dataset(root, tmp_path):
    folder = store_of(root)
    other = write_dataset(tmp_path / "other", seed=5)
    shutil.copytree(root / "geometry", other / "geometry")
    with pytest.raises(
        ValueError, match=rf"No feature store in .* fits: {folder.name}: the dataset {other} has changed since"
    ):
        make_stored(other)
    with pytest.raises(
        ValueError, match=rf"store {folder} does not fit: the dataset {other} has changed since, or is another"
    ):
        make_stored(other, features_path=str(folder))
    (data,) = (root / "data").rglob("*.parquet")
    data.write_bytes(data.read_bytes() + b" ")
    with pytest.raises(
        ValueError, match=rf"the dataset's {data} has another size than when the features were computed"
    ):
        make_stored(root)


def test_what_features_do_not_depend_on_may_change(root):
    """Calibrating the cameras of a dataset, or recomputing its statistics, invalidates no feature."""
    (root / "meta" / "info.json").write_text((root / "meta" / "info.json").read_text() + " ")
    (root / "meta" / "stats.json").unlink()
    make_stored(root)


def test_more_episodes_are_computed_alone(root, original):
    """One more recording: the files of the old frames stay, and training reads old frames and new ones."""
    encoder = original.parent / "encoder"
    folder, before = store_of(root), files(store_of(root))
    old = make_stored(root).geometry.source(frames_of(root)).features
    add_episodes(root, (6,))
    with pytest.raises(ValueError, match=r"has 1 more episode\(s\) since; .* which computes the new frames alone"):
        make_stored(root)
    dataset = LeRobotDataset(REPO_ID, root=root, return_uint8=True)
    work = prepare(dataset, str(encoder), 3, image_size=42, shard_frames=10)
    assert work.folder == folder
    begin(work)
    asked: list[int] = []
    work.run(4, on_progress=lambda frames, found: asked.append(frames))
    assert sum(asked) == 6
    after = files(folder)
    assert {name: after[name] for name in before if name.startswith("shard")} == {
        name: content for name, content in before.items() if name.startswith("shard")
    }
    grown = make_stored(root)
    assert torch.equal(grown.geometry.source(frames_of(root)).features, old)
    batch = frames_of(root, (26, 31))
    live = make_stored(None, geometry_source="da3", da3_encoder=str(encoder), da3_image_size=42)
    expected = live.geometry.source(without(batch, "index")).features
    torch.testing.assert_close(grown.geometry.source(batch).features, expected, rtol=2**-7, atol=5e-3)
    again = prepare(dataset, str(encoder), 3, image_size=42, shard_frames=10)
    assert (again.folder, again.missing()) == (folder, [])


def test_episodes_that_changed_make_another_store(root, original, tmp_path):
    other = write_dataset(tmp_path / "other", (9, 5, 12, 3), seed=5)
    shutil.copytree(root / "geometry", other / "geometry")
    assert compute(other, original.parent / "encoder") != other / "geometry" / store_of(root).name


def test_another_grid_camera_order_or_precision(root):
    with pytest.raises(
        ValueError, match=r"3 x 3 cells per camera, the policy 2 x 2; set --policy.geometry_grid=3, or run"
    ):
        make_stored(root, geometry_grid=2)
    for cameras in (["wrist", "front"], ["front"]):
        with pytest.raises(
            ValueError, match=r"has the cameras front \(.*\), wrist .* set --policy.geometry_cameras='\[\"front"
        ):
            make_stored(root, geometry_cameras=cameras)
    with pytest.raises(
        ValueError, match=r"da3_dtype bfloat16, the policy has float32; set --policy.da3_dtype=bfloat16"
    ):
        make_stored(root, da3_dtype="float32")
    with pytest.raises(ValueError, match=r"da3_image_size 42, the policy has 84; set --policy.da3_image_size=42"):
        make_stored(root, da3_image_size=84)


def test_another_encoder(root, original, tmp_path):
    """Content decides: the same weights under another name are the same encoder."""
    other = write_tiny(tmp_path / "other" / "model.safetensors", seed=1).parent
    with pytest.raises(
        ValueError, match=rf"features are from another encoder: .*; run pi05-geometry precompute --encoder={other}"
    ):
        make_stored(root, da3_encoder=str(other))
    same = shutil.copytree(original.parent / "encoder", tmp_path / "same")
    assert make_stored(root, da3_encoder=str(same)).config.da3_encoder == str(same)
    compute(root, other)
    with pytest.raises(
        ValueError, match=r"Several feature stores in .* fit \(.*\); name one by --policy.features_path"
    ):
        make_stored(root)
    policy = make_stored(root, da3_encoder=str(other))
    assert policy.config.da3_encoder == str(other)
    assert policy.config.da3_hash != make_stored(root, da3_encoder=str(same)).config.da3_hash


def test_a_corrupted_file_or_a_missing_frame_stops_training(root):
    file = store_of(root) / "shard-00001.bin"
    content = bytearray(file.read_bytes())
    content[500] ^= 1
    file.write_bytes(content)
    policy, batch = make_stored(root).train(), frames_of(root)
    with pytest.raises(
        ValueError, match=rf"^Store file {file} is damaged at frame 10: its checksum does not fit; delete it"
    ):
        policy.forward(batch | {"index": torch.tensor([3, 10, 4, 5])})
    with pytest.raises(ValueError, match=r"has no frame 26 \(it has 0 to 25\)"):
        policy.forward(batch | {"index": torch.tensor([3, 26, 4, 5])})
    with pytest.raises(ValueError, match=r"A training batch has no 'index'"):
        policy.forward(without(batch, "index"))
    file.unlink()
    with pytest.raises(
        FileNotFoundError, match=r"not finished: 1 of 3 files are missing, beginning with shard-00001.bin"
    ):
        make_stored(root)


def test_augmented_images_are_refused_where_it_can_be_seen(root):
    def training(augment: bool, source: str) -> TrainPipelineConfig:
        transforms = ImageTransformsConfig(enable=augment)
        policy = make_config(geometry_source=source)
        return TrainPipelineConfig(dataset=DatasetConfig(repo_id=REPO_ID, image_transforms=transforms), policy=policy)

    refuse_augmentation(training(False, "features"))
    refuse_augmentation(training(True, "da3"))
    with pytest.raises(
        ValueError, match=r"cannot be augmented: set --dataset.image_transforms.enable=false, or train with"
    ):
        refuse_augmentation(training(True, "features"))
