"""Reading a store: frames by dataset index, in any order."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Thread

import psutil
import torch
from torch import Tensor

from .manifest import Manifest, read_manifest
from .shards import is_good, map_records

_SHARE_OF_MEMORY = 0.5  # of the free memory; a larger store would evict its own pages from the cache
_BLOCK = 1 << 23  # bytes
_MEND = "delete it and run pi05-geometry precompute again, which computes this file alone"


class FeatureStore:
    """A finished store. Opening checks the names and sizes of its files; a frame's checksum is checked when it is first read.

    Checking the checksums of a large store at the start would take minutes.
    Raises FileNotFoundError or ValueError, with one sentence, for a store that is unfinished or has a wrong file.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.manifest = folder, read_manifest(folder)
        missing = missing_shards(folder, self.manifest)
        if missing:
            raise FileNotFoundError(
                f"The feature store {folder} is not finished: {len(missing)} of {self.manifest.shards} files are missing, "
                f"beginning with {self.manifest.shard_path(folder, missing[0]).name}; run pi05-geometry precompute again, "
                "which continues where it stopped."
            )
        for shard in range(self.manifest.shards):
            self._check_size(shard)
        self._maps: dict[int, Tensor] = {}
        self._checked = torch.zeros(self.manifest.frames, dtype=torch.bool)

    def read(self, indices: Sequence[int], pin: bool = False) -> Tensor:
        """Features (B, V, G, C) bfloat16 of frames. pin: into page-locked memory, so that the copy to a GPU is asynchronous.

        Raises ValueError for a frame that the store does not have, or that is damaged.
        """
        features = torch.empty(len(indices), *self.manifest.shape, dtype=torch.bfloat16, pin_memory=pin)
        for row, index in zip(features.flatten(1), indices, strict=True):
            row.copy_(self._record(index)[: row.numel()])
        return features

    def read_ahead(self) -> Thread | None:
        """Read every file once, in the background, so that shuffled frames soon come from memory; None if they do not fit.

        A policy gets the indices of a batch together with the batch, so it cannot read single frames ahead.
        """
        size = self.manifest.frames * self.manifest.record_bytes
        if size > _SHARE_OF_MEMORY * psutil.virtual_memory().available:
            return None
        thread = Thread(target=self._read_all, name="feature store read-ahead", daemon=True)
        thread.start()
        return thread

    def _read_all(self) -> None:
        block = bytearray(_BLOCK)
        for shard in range(self.manifest.shards):
            try:
                with self.manifest.shard_path(self.folder, shard).open("rb", buffering=0) as file:
                    while file.readinto(block):
                        pass
            except OSError:  # reading a frame of this file raises the error
                return

    def verify(self) -> Iterator[int]:
        """Compare every file with its SHA-256; yields the number of bytes after each. Raises ValueError at a damaged one."""
        for shard in range(self.manifest.shards):
            path = self.manifest.shard_path(self.folder, shard)
            beside = path.with_suffix(".sha256")
            if not beside.is_file():
                raise FileNotFoundError(f"Checksum file {beside} is missing; {_MEND} ({path.name}).")
            with path.open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
            if beside.read_text() != f"{found}  {path.name}\n":
                raise ValueError(f"Store file {path} is damaged: it is not what {beside.name} says; {_MEND}.")
            yield self.manifest.shard_bytes(shard)

    def _record(self, index: int) -> Tensor:
        if not 0 <= index < self.manifest.frames:
            raise ValueError(
                f"The feature store {self.folder} has no frame {index} (it has 0 to {self.manifest.frames - 1}): the batch is "
                "not from the dataset that it was made of; run pi05-geometry precompute for this one."
            )
        shard = self.manifest.shard_of(index)
        row = index - self.manifest.frames_of(shard).start
        if shard not in self._maps:
            self._check_size(shard)
            path = self.manifest.shard_path(self.folder, shard)
            self._maps[shard] = map_records(path, self.manifest, len(self.manifest.frames_of(shard)))
        record = self._maps[shard][row]
        if not self._checked[index]:
            if not is_good(record, self.manifest.key, index):
                path = self.manifest.shard_path(self.folder, shard)
                raise ValueError(f"Store file {path} is damaged at frame {index}: its checksum does not fit; {_MEND}.")
            self._checked[index] = True
        return record

    def _check_size(self, shard: int) -> None:
        path, expected = self.manifest.shard_path(self.folder, shard), self.manifest.shard_bytes(shard)
        found = path.stat().st_size if path.is_file() else 0
        if found != expected:
            raise ValueError(f"Store file {path} is damaged: expected {expected} bytes, found {found}; {_MEND}.")


def missing_shards(folder: Path, manifest: Manifest) -> list[int]:
    """Shards that are not finished."""
    return [shard for shard in range(manifest.shards) if not manifest.shard_path(folder, shard).is_file()]
