"""manifest.json: what a store's features depend on, and how they are laid out."""

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from ...weight_files.files import write_whole

MANIFEST_FILE = "manifest.json"
FORMAT = 1
_CRC_BYTES = 4


@dataclass(frozen=True)
class Manifest:
    """One store.

    encoder: id under which the encoder was found; encoder_hash: SHA-256 of its backbone, which decides. image_size: pixels per
    side. dtype: what the encoder computed in. cameras: name -> key of the images, in token order. feature_dim: C.
    dataset_hash, dataset_files: see `fingerprint`. frames: of the dataset. shard_frames: of each file but the last.
    """

    encoder: str
    encoder_hash: str
    image_size: int
    dtype: str
    grid: int
    cameras: dict[str, str]
    feature_dim: int
    dataset_hash: str
    dataset_files: dict[str, int]
    frames: int
    shard_frames: int
    format: int = FORMAT

    @property
    def key(self) -> str:
        """Name of the store's folder: a digest of everything that the features depend on."""
        parts = {name: value for name, value in asdict(self).items() if name not in ("encoder", "shard_frames")}
        parts["cameras"] = list(self.cameras.items())  # their order decides
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(V, G, C) of one frame."""
        return len(self.cameras), self.grid**2, self.feature_dim

    @property
    def record_bytes(self) -> int:
        """Bytes of one frame: bfloat16 features and their checksum."""
        views, cells, width = self.shape
        return 2 * views * cells * width + _CRC_BYTES

    @property
    def shards(self) -> int:
        return -(-self.frames // self.shard_frames)

    def frames_of(self, shard: int) -> range:
        """Dataset indices of a shard's frames."""
        start = shard * self.shard_frames
        return range(start, min(start + self.shard_frames, self.frames))

    def shard_bytes(self, shard: int) -> int:
        return len(self.frames_of(shard)) * self.record_bytes

    def shard_path(self, folder: Path, shard: int) -> Path:
        return folder / f"shard-{shard:05d}.bin"

    def write(self, folder: Path) -> None:
        text = json.dumps({"key": self.key, **asdict(self)}, indent=2, sort_keys=False)
        write_whole(folder / MANIFEST_FILE, text + "\n")


def read_manifest(folder: Path) -> Manifest:
    """Raises FileNotFoundError or ValueError, with one sentence, for a folder that is no store."""
    path = folder / MANIFEST_FILE
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} is no feature store ({MANIFEST_FILE} is missing); make one with pi05-geometry precompute."
        )
    try:
        content = dict(json.loads(path.read_text()))
        key = content.pop("key")
        if content.get("format") != FORMAT:
            raise ValueError(
                f"{path} has format {content.get('format')}, this version reads {FORMAT}; compute it again."
            )
        if set(content) != {field.name for field in fields(Manifest)}:
            raise KeyError("other entries than expected")
        manifest = Manifest(**content)
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}); delete it and run pi05-geometry precompute again, which keeps the finished files."
        ) from error
    if manifest.key != key:
        raise ValueError(f"{path} was changed by hand: its key is {key}, its content has {manifest.key}; restore it.")
    return manifest
