"""manifest.json: what a store's features depend on, and how they are laid out.

A store grows with its dataset. When episodes were added, `parts` gets one more entry: the new frames go into files of their
own, and a finished file is never written again.
"""

import hashlib
import json
from bisect import bisect_right
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from ...weight_files.files import write_whole
from .fingerprint import Episodes

MANIFEST_FILE = "manifest.json"
FORMAT = 2
_CRC_BYTES = 4
_DIGEST = "digest"


@dataclass(frozen=True)
class Manifest:
    """One store. Made by `Manifest.new`.

    encoder: id under which the encoder was found; encoder_hash: SHA-256 of its backbone, which identifies it. image_size: pixels
    per side. dtype: what the encoder computed in. cameras: name -> key of the images, in token order. feature_dim: C.
    episode_frames, episode_hashes, dataset_files: of the dataset, see `fingerprint`. shard_frames: of each file but the last of
    a part. parts: frames of the dataset when the store was made, and each time that it was extended. key: name of the folder,
    a digest of what the features depended on when the store was made; it stays when the store grows.
    """

    encoder: str
    encoder_hash: str
    image_size: int
    dtype: str
    grid: int
    cameras: dict[str, str]
    feature_dim: int
    episode_frames: list[int]
    episode_hashes: list[str]
    dataset_files: dict[str, int]
    shard_frames: int
    parts: list[int]
    key: str
    format: int = FORMAT

    @classmethod
    def new(cls, episodes: Episodes, **settings: Any) -> "Manifest":
        """A store of these episodes. settings: the fields that are neither of episodes nor `parts` nor `key`."""
        frames = [sum(episodes.frames)]
        begun = cls(**settings, episode_frames=episodes.frames, episode_hashes=episodes.hashes, parts=frames, key="")
        parts = {name: value for name, value in asdict(begun).items() if name not in ("encoder", "shard_frames", "key")}
        parts["cameras"] = list(begun.cameras.items())  # their order matters
        return replace(begun, key=_digest(parts)[:16])

    def extended(self, episodes: Episodes, dataset_files: dict[str, int]) -> "Manifest":
        """This store for a dataset that has more episodes since; the same if it has not."""
        frames = sum(episodes.frames)
        parts = self.parts if frames == self.frames else [*self.parts, frames]
        return replace(
            self,
            episode_frames=episodes.frames,
            episode_hashes=episodes.hashes,
            dataset_files=dataset_files,
            parts=parts,
        )

    @property
    def episodes(self) -> Episodes:
        return Episodes(self.episode_frames, self.episode_hashes)

    @property
    def recipe(self) -> tuple[Any, ...]:
        """What turns a frame into features: stores with the same recipe differ in their frames only."""
        cameras = tuple(self.cameras.items())
        return self.encoder_hash, self.image_size, self.dtype, self.grid, cameras, self.feature_dim

    @property
    def frames(self) -> int:
        return self.parts[-1]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(V, G, C) of one frame."""
        return len(self.cameras), self.grid**2, self.feature_dim

    @property
    def record_bytes(self) -> int:
        """Bytes of one frame: bfloat16 features and their checksum."""
        views, cells, width = self.shape
        return 2 * views * cells * width + _CRC_BYTES

    @cached_property
    def _starts(self) -> list[int]:
        """Dataset index of the first frame of every shard."""
        return [start for low, high in pairwise((0, *self.parts)) for start in range(low, high, self.shard_frames)]

    @property
    def shards(self) -> int:
        return len(self._starts)

    def frames_of(self, shard: int) -> range:
        """Dataset indices of a shard's frames."""
        last = shard + 1 == len(self._starts)
        return range(self._starts[shard], self.frames if last else self._starts[shard + 1])

    def shard_of(self, index: int) -> int:
        """The shard that holds a frame."""
        return bisect_right(self._starts, index) - 1

    def shard_bytes(self, shard: int) -> int:
        return len(self.frames_of(shard)) * self.record_bytes

    def shard_path(self, folder: Path, shard: int) -> Path:
        return folder / f"shard-{shard:05d}.bin"

    def write(self, folder: Path) -> None:
        content = asdict(self)
        write_whole(folder / MANIFEST_FILE, json.dumps({_DIGEST: _digest(content), **content}, indent=2) + "\n")


def read_manifest(folder: Path) -> Manifest:
    """Raises FileNotFoundError or ValueError, with one sentence, for a folder that is no store."""
    path = folder / MANIFEST_FILE
    content = _read(path)
    if content.get("format") != FORMAT:
        raise ValueError(
            f"{path} has format {content.get('format')}, this version reads {FORMAT}; run pi05-geometry precompute again."
        )
    digest = content.pop(_DIGEST, None)
    if set(content) != {field.name for field in fields(Manifest)}:
        raise ValueError(f"{path} is damaged (other entries than expected); {_AGAIN}.")
    if digest != _digest(content):
        raise ValueError(f"{path} was changed by hand: its content does not have the digest {digest}; restore it.")
    return Manifest(**content)


_AGAIN = "delete it and run pi05-geometry precompute again, which keeps the finished files"


def stores_in(folder: Path) -> dict[Path, Manifest]:
    """The stores in a folder, sorted by name. Stores of earlier formats are not among them."""
    paths = sorted(folder.glob(f"*/{MANIFEST_FILE}"))
    return {path.parent: read_manifest(path.parent) for path in paths if _read(path).get("format") == FORMAT}


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path.parent} is no feature store ({MANIFEST_FILE} is missing); make one with pi05-geometry precompute."
        )
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); {_AGAIN}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged (no JSON object); {_AGAIN}.")
    return content


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
