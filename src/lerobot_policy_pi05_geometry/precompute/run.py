"""Computes the files of a store, one after the other. Interrupted and started again, it continues where it stopped.

Processes share the work file by file: rank r of W takes files r, r + W, ... Each file is written by one process at a time
(a lock), and gets its name when it is complete, so the store is finished when all its files exist. When the dataset has more
episodes than the store, files for the new frames are added.
"""

import errno
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.da3 import Da3Source
from ..geometry.da3.weights import load_da3
from ..geometry.feature_store import FeatureStore, Manifest, read_manifest
from ..geometry.feature_store.fingerprint import changed_file, frame_files, read_episodes
from ..geometry.feature_store.manifest import MANIFEST_FILE, stores_in
from ..geometry.feature_store.match import STORES
from ..geometry.feature_store.reader import missing_shards
from ..geometry.feature_store.shards import lock_beside, writing
from .frames import Frames

SHARD_FRAMES = 512  # 100 MB for one camera of DA3-BASE at 8 x 8: small enough to divide among processes, and few files


@dataclass(frozen=True)
class Precompute:
    """What is to be computed: the frames, the source that encodes them, and the store."""

    frames: Frames
    source: Da3Source
    manifest: Manifest
    folder: Path

    def missing(self, rank: int = 0, world_size: int = 1) -> list[int]:
        """Files of this rank that are not finished."""
        return [shard for shard in missing_shards(self.folder, self.manifest) if shard % world_size == rank]

    def run(
        self,
        batch_size: int,
        device: str | torch.device = "cpu",
        rank: int = 0,
        world_size: int = 1,
        on_progress: Callable[[int, bool], None] = lambda frames, found: None,
    ) -> None:
        """Compute this rank's share. on_progress: called with a number of frames that are done in addition, and whether
        they were found in an unfinished file.

        Batches begin at multiples of `batch_size` within a file, wherever this was interrupted: the files are then the same
        to the byte. Raises OSError when the disk is full; what is computed is kept.
        """
        if batch_size < 1:
            raise ValueError(f"--batch-size must be at least 1, got {batch_size}.")
        for shard in self.missing(rank, world_size):
            with writing(self.folder, self.manifest, shard, batch_size) as writer:
                if writer is None:
                    continue
                on_progress(writer.done, True)
                try:
                    for batch, images in self.frames.read_ahead(writer.batches()):
                        geometry = self.source({key: image.to(device) for key, image in images.items()})
                        writer.append(geometry.features)
                        on_progress(len(batch), False)
                    writer.finish()
                except OSError as error:
                    if error.errno != errno.ENOSPC:
                        raise
                    raise OSError(
                        f"The disk of {self.folder} is full; what is computed is kept, so make room and run this again."
                    ) from error


def prepare(
    dataset: LeRobotDataset,
    encoder: str,
    grid: int,
    cameras: list[str] | None = None,
    image_size: int | None = None,
    dtype: str = "bfloat16",
    output: Path | None = None,
    shard_frames: int = SHARD_FRAMES,
) -> Precompute:
    """Find the encoder and the cameras, as a policy with these settings does, and the store for them.

    output: folder for stores; None: the dataset's own. Writes nothing.
    Raises FileNotFoundError or ValueError, with one sentence, for what is not found or does not fit.
    """
    if shard_frames < 1:
        raise ValueError(f"--shard-frames must be at least 1, got {shard_frames}.")
    root = Path(dataset.root)
    config = PI05GeometryConfig(
        geometry_source="da3",
        geometry_grid=grid,
        geometry_cameras=cameras,
        da3_encoder=encoder,
        da3_image_size=image_size,
        da3_dtype=dtype,
        input_features=dataset_to_policy_features(dataset.meta.features),
        device="cpu",
    )
    config.set_dataset_feature_metadata(dataset.meta.features)  # which tells depth from colour
    config.validate_features()
    keys = config.rgb_cameras()
    if not keys:
        raise ValueError(f"The dataset {root} has no RGB images, so there is nothing to compute features from.")
    source = Da3Source(keys, grid, load_da3(config), config.da3_image_size)
    assert source.encoder.content_hash is not None
    manifest = Manifest.new(
        read_episodes(root),
        encoder=encoder,
        encoder_hash=source.encoder.content_hash,
        image_size=source.image_size,
        dtype=dtype,
        grid=grid,
        cameras=keys,
        feature_dim=source.feature_dim,
        dataset_files=frame_files(root),
        shard_frames=shard_frames,
    )
    stores = root / STORES if output is None else output
    folder, manifest = _extending(stores, root, manifest) or (stores / manifest.key, manifest)
    return Precompute(Frames(dataset, list(keys.values())), source, manifest, folder)


def _extending(stores: Path, root: Path, wanted: Manifest) -> tuple[Path, Manifest] | None:
    """Folder and manifest of the store that holds most of the wanted frames, extended to all of them; None if no store can be.

    It must have the same recipe, and the dataset must begin with the store's episodes, in files that have not changed.
    """
    begun = [
        (folder, manifest)  # the folder that was found: a manifest comes with a dataset, and could name another one
        for folder, manifest in stores_in(stores).items()
        if manifest.recipe == wanted.recipe
        and wanted.episodes.begins_with(manifest.episodes)
        and changed_file(root, manifest.dataset_files, allow_new=True) is None
    ]
    if not begun:
        return None
    folder, longest = max(begun, key=lambda store: store[1].frames)
    if longest.shard_frames != wanted.shard_frames:
        raise ValueError(
            f"The store {folder} was begun with {longest.shard_frames} frames per file, not "
            f"{wanted.shard_frames}; continue with --shard-frames={longest.shard_frames}, or delete it."
        )
    return folder, longest.extended(wanted.episodes, wanted.dataset_files)


def begin(work: Precompute) -> None:
    """Write the store's folder and manifest, where they do not exist or the dataset has grown.

    Raises OSError if the disk cannot hold the rest of the features.
    """
    needed, free = disk_needed(work), free_bytes(work.folder)
    if needed > free:
        raise OSError(
            f"The disk of {work.folder} cannot hold the features: {needed / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB are "
            "free; make room, or choose another folder by --output."
        )
    work.folder.mkdir(parents=True, exist_ok=True)
    with lock_beside(work.folder, "manifest"):
        if not (work.folder / MANIFEST_FILE).exists() or read_manifest(work.folder) != work.manifest:
            work.manifest.write(work.folder)


def disk_needed(work: Precompute) -> int:
    """Bytes that the store will still take."""
    needed = 0
    for shard in missing_shards(work.folder, work.manifest):
        partial = work.manifest.shard_path(work.folder, shard).with_suffix(".partial")
        there = partial.stat().st_size if partial.exists() else 0
        needed += max(0, work.manifest.shard_bytes(shard) - there)
    return needed


def free_bytes(folder: Path) -> int:
    """Bytes free where `folder` is, or will be."""
    there = next(path for path in [folder.absolute(), *folder.absolute().parents] if path.exists())
    return shutil.disk_usage(there).free


def verify(folder: Path) -> Iterator[int]:
    """Read the whole store and compare it with its checksums; yields the bytes of each file that is right."""
    return FeatureStore(folder).verify()
