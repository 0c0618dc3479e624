"""Safetensors files copied tensor by tensor, as bytes, in the dtype they have.

The format: 8 bytes of header length, a JSON header {name: {dtype, shape, data_offsets}}, the tensors' bytes. So a file of
any size is written from others without a tensor in memory. Source: the format's description in safetensors' README.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import torch
from safetensors import SafetensorError, safe_open

from ...weight_files.strict_load import complain

_CHUNK = 1 << 24  # bytes copied at a time
_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8}
_DTYPES = {torch.float32: "F32", torch.bfloat16: "BF16", torch.int64: "I64"}

_FLOATS = ("F64", "F32", "F16", "BF16")


@dataclass(frozen=True)
class StoredTensor:
    """A tensor in a file: its dtype in safetensors' spelling, its shape, and where its bytes start."""

    path: Path
    dtype: str
    shape: tuple[int, ...]
    start: int


@dataclass(frozen=True)
class Zeros:
    """A tensor that is written as zeros."""

    dtype: str
    shape: tuple[int, ...]


def read_tensors(path: Path) -> dict[str, StoredTensor]:
    """What a safetensors file holds, without reading it. Raises ValueError if it is truncated or no safetensors file."""
    try:
        with safe_open(path, framework="pt"):
            pass  # checks the header, and that the file is as long as it says
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file ({error}); copy or download it again.") from error
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
    header.pop("__metadata__", None)
    return {
        name: StoredTensor(path, entry["dtype"], tuple(entry["shape"]), 8 + length + entry["data_offsets"][0])
        for name, entry in header.items()
    }


def check_weights(path: Path, expected: Mapping[str, tuple[int, ...]], found: Mapping[str, StoredTensor]) -> None:
    """Raise ValueError unless these are the expected names in the expected shapes, all of floating-point dtype."""
    left = "nothing was written"
    complain(path, "lacks", sorted(expected.keys() - found.keys()), left)
    complain(path, "has unknown", sorted(found.keys() - expected.keys()), left)
    wrong = []
    for name, shape in expected.items():
        if found[name].shape != shape:
            wrong.append(f"{name} (shape {found[name].shape}, expected {shape})")
        elif found[name].dtype not in _FLOATS:
            wrong.append(f"{name} (dtype {found[name].dtype}, expected one of {', '.join(_FLOATS)})")
    complain(path, "has wrong", wrong, left)


def write_tensors(path: Path, tensors: Mapping[str, StoredTensor | Zeros | torch.Tensor]) -> None:
    """Write a safetensors file. Widest dtypes come first, as the format wants it for alignment."""
    sizes = {name: _size(tensor) for name, tensor in tensors.items()}
    order = sorted(tensors, key=lambda name: (-_BYTES[_dtype(tensors[name])], name))
    header: dict[str, object] = {"__metadata__": {"format": "pt"}}
    end = 0
    for name in order:
        begin, end = end, end + sizes[name]
        tensor = tensors[name]
        header[name] = {"dtype": _dtype(tensor), "shape": list(tensor.shape), "data_offsets": [begin, end]}
    encoded = json.dumps(header).encode()
    encoded += b" " * (-len(encoded) % 8)
    with path.open("xb") as file:
        file.write(len(encoded).to_bytes(8, "little") + encoded)
        for name in order:
            _write(file, tensors[name], sizes[name])


def total_size(tensors: Mapping[str, StoredTensor | Zeros | torch.Tensor]) -> int:
    """Bytes of the tensors."""
    return sum(map(_size, tensors.values()))


def _dtype(tensor: StoredTensor | Zeros | torch.Tensor) -> str:
    return _DTYPES[tensor.dtype] if isinstance(tensor, torch.Tensor) else tensor.dtype


def _size(tensor: StoredTensor | Zeros | torch.Tensor) -> int:
    return torch.Size(tensor.shape).numel() * _BYTES[_dtype(tensor)]


def _write(file: BinaryIO, tensor: StoredTensor | Zeros | torch.Tensor, size: int) -> None:
    if isinstance(tensor, torch.Tensor):
        file.write(tensor.detach().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    elif isinstance(tensor, Zeros):
        for begin in range(0, size, _CHUNK):
            file.write(bytes(min(_CHUNK, size - begin)))
    else:
        with tensor.path.open("rb") as source:
            source.seek(tensor.start)
            for begin in range(0, size, _CHUNK):
                file.write(source.read(min(_CHUNK, size - begin)))
