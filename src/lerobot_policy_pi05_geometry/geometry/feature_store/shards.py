"""The files of features: an interruption loses no finished frame, and every frame is checked when it is read.

shard-00000.partial   grows by whole batches; its checksums say how many frames are good
shard-00000.sha256    of the finished file, as `sha256sum -c` reads it; written before the file gets its name
shard-00000.bin       finished, never written again
"""

import hashlib
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import FileLock, Timeout
from torch import Tensor

from ...weight_files.files import write_whole
from .manifest import Manifest

_CRC_ELEMENTS = 2  # a CRC-32 is as long as two bfloat16 numbers


def checksum(features: Tensor, key: str, index: int) -> int:
    """CRC-32 of a frame's features (contiguous bfloat16), of the store's key and of the frame's index.

    Key and index are included, so that a file of another store, or under another number, is detected.
    """
    return zlib.crc32(features.flatten().view(torch.uint8).numpy(), zlib.crc32(f"{key} {index}".encode()))


def records(features: Tensor, key: str, first: int) -> bytes:
    """Records of frames `first`, `first + 1`, ...: features (B, V, G, C) -> bytes, rounded to bfloat16."""
    rounded = features.to("cpu", torch.bfloat16).contiguous()
    parts = []
    for offset, frame in enumerate(rounded):
        parts += [
            frame.flatten().view(torch.uint8).numpy().tobytes(),
            checksum(frame, key, first + offset).to_bytes(4, "little"),
        ]
    return b"".join(parts)


def map_records(path: Path, manifest: Manifest, frames: int) -> Tensor:
    """The first `frames` records of a file as a memory map: (frames, V * G * C + 2) bfloat16, not to be written to.

    The file is closed at once: thousands of open shards would exceed the limit of open files.
    """
    size = frames * manifest.record_bytes // 2
    return torch.from_file(str(path), shared=False, size=size, dtype=torch.bfloat16).view(frames, -1)


def is_good(record: Tensor, key: str, index: int) -> bool:
    """Whether a record holds what was written for this frame."""
    stored = int.from_bytes(record[-_CRC_ELEMENTS:].view(torch.uint8).numpy().tobytes(), "little")
    return checksum(record[:-_CRC_ELEMENTS], key, index) == stored


class ShardWriter:
    """Appends batches to one shard. Made by `writing`, which allows one writer at a time."""

    def __init__(self, folder: Path, manifest: Manifest, shard: int, batch: int) -> None:
        self._manifest, self._frames, self._batch = manifest, manifest.frames_of(shard), batch
        self._path = manifest.shard_path(folder, shard)
        self._partial = self._path.with_suffix(".partial")
        self.done = self._good_frames()
        if self.done < len(self._frames):
            self.done -= self.done % batch  # a batch that is incomplete is computed again
        with self._partial.open("ab") as file:
            file.truncate(self.done * manifest.record_bytes)

    def _good_frames(self) -> int:
        """How many frames from the start are complete and correct."""
        if not self._partial.exists():
            return 0
        whole = min(self._partial.stat().st_size // self._manifest.record_bytes, len(self._frames))
        if whole == 0:
            return 0
        for i, record in enumerate(map_records(self._partial, self._manifest, whole)):
            if not is_good(record, self._manifest.key, self._frames[i]):
                return i
        return whole

    def batches(self) -> list[range]:
        """Dataset indices of the batches that remain; an interruption does not change them."""
        starts = range(self._frames.start + self.done, self._frames.stop, self._batch)
        return [range(start, min(start + self._batch, self._frames.stop)) for start in starts]

    def append(self, features: Tensor) -> None:
        """Write the next batch: (B, V, G, C)."""
        with self._partial.open("ab") as file:
            file.write(records(features, self._manifest.key, self._frames[self.done]))
        self.done += len(features)

    def finish(self) -> None:
        """Give the complete file its final name."""
        with self._partial.open("rb+") as file:
            os.fsync(file.fileno())
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        write_whole(self._path.with_suffix(".sha256"), f"{digest}  {self._path.name}\n")
        os.replace(self._partial, self._path)


@contextmanager
def writing(folder: Path, manifest: Manifest, shard: int, batch: int) -> Iterator[ShardWriter | None]:
    """A writer that continues where the last one stopped; None if the shard is finished, or another process writes it."""
    lock = lock_beside(folder, f"shard-{shard:05d}")
    try:
        with lock.acquire(timeout=0):
            finished = manifest.shard_path(folder, shard).exists()
            yield None if finished else ShardWriter(folder, manifest, shard, batch)
    except Timeout:
        yield None


def lock_beside(folder: Path, name: str) -> FileLock:
    """A lock that ends with its process. Its file is outside of the store, which holds results only."""
    locks = folder.parent / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    return FileLock(locks / f"{folder.name}-{name}.lock")
