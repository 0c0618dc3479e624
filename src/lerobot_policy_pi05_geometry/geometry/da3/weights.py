"""Depth Anything 3's weights: found by name, identified by content, and never part of the policy's own checkpoint.

The checkpoint records the encoder that it was trained with: its id, and the SHA-256 of its backbone's tensors. The hash is of
the tensors and not of the file: a copy without the heads, or one written by another version of safetensors, is the same encoder.
"""

import hashlib
import logging
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from safetensors import SafetensorError, safe_open

from ...model.precision import DTYPES
from ...weight_files.files import find_file
from ...weight_files.strict_load import load_strictly
from . import BACKBONE_PREFIX, OTHER_PREFIXES, Da3Backbone, Da3Encoder, Da3Variant, variant_of
from .encoder import store_products_in

if TYPE_CHECKING:
    from ...configuration_pi05_geometry import PI05GeometryConfig

logger = logging.getLogger(__name__)

_warned: set[str] = set()


def load_da3(config: "PI05GeometryConfig") -> Da3Encoder:
    """The encoder that the configuration names, on the CPU; a hash that the configuration has is verified.

    Do not call it where parameters are created on the meta device: its weights are read at once.
    Raises FileNotFoundError or ValueError, with one sentence, for an encoder that is not found, is damaged, or is another.
    """
    path, encoder = _identify(config)
    load_strictly(encoder.backbone, path, BACKBONE_PREFIX, OTHER_PREFIXES)
    return encoder


def meta_da3(config: "PI05GeometryConfig") -> Da3Encoder:
    """The same without its weights, for its sizes and its hash."""
    return _identify(config)[1]


def _identify(config: "PI05GeometryConfig") -> tuple[Path, Da3Encoder]:
    """File and architecture of the configuration's encoder, with parameters on the meta device."""
    name = config.da3_encoder
    if name is None:
        raise ValueError("This policy names no Depth Anything 3 encoder; give one by --policy.da3_encoder.")
    path = find_encoder(name)
    variant = read_variant(path)
    _warn_of_licence(name, variant)
    found = backbone_hash(path)
    if config.da3_hash not in (None, found):
        raise ValueError(
            f"This policy was trained with another encoder than {name} holds: expected SHA-256 "
            f"{config.da3_hash} of the backbone, {path} has {found}; give the one it was trained with by "
            "--policy.da3_encoder."
        )
    dtype = DTYPES[config.da3_dtype]
    with torch.device("meta"):
        backbone = Da3Backbone(variant)
    store_products_in(backbone, dtype)
    return path, Da3Encoder(backbone, dtype, found)


def read_variant(path: Path) -> Da3Variant:
    """Which Depth Anything 3 a released file holds, from its header."""
    try:
        with safe_open(path, framework="pt") as file:
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file ({error}); copy or download it again.") from error
    return variant_of(shapes, str(path))


def backbone_hash(path: Path) -> str:
    """SHA-256 over the backbone's tensors in the order of their names: name, dtype, shape and bytes of each."""
    digest = hashlib.sha256()
    with safe_open(path, framework="pt") as file:
        for name in sorted(file.keys()):
            if name.startswith(BACKBONE_PREFIX):
                tensor = file.get_tensor(name)
                digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
                digest.update(tensor.contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()


def find_encoder(encoder: str) -> Path:
    """The encoder's file: `encoder` is that file, its folder, or a hub id."""
    if Path(encoder).is_file():
        return Path(encoder)
    try:
        return find_file(encoder, SAFETENSORS_SINGLE_FILE)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"The Depth Anything 3 encoder is not found: {str(error).removesuffix('.')}; give a hub id, a folder or a "
            "safetensors file by --policy.da3_encoder (convert: --da3-encoder; a checkpoint holds none of the encoder's weights)."
        ) from error


def _warn_of_licence(encoder: str, variant: Da3Variant) -> None:
    """Log once per encoder that its weights are not for commercial use."""
    if variant.non_commercial and encoder not in _warned:
        _warned.add(encoder)
        logger.warning(
            "%s is Depth Anything 3's '%s', whose weights are released under CC BY-NC 4.0, so not for commercial use; "
            "depth-anything/DA3-SMALL and DA3-BASE are Apache-2.0.", encoder, variant.name,
        )  # fmt: skip
