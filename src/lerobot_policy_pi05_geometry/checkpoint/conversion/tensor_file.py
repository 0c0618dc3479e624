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

_CHUNK = 1 << 22  # numbers copied at a time
_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8}
_TORCH = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
}
_DTYPES = {dtype: name for name, dtype in _TORCH.items()}

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


def read_tensor(stored: StoredTensor) -> torch.Tensor:
    """A small tensor, into memory. Raises ValueError if it is cut off."""
    size = _size(stored)
    with stored.path.open("rb") as file:
        file.seek(stored.start)
        content = bytearray(file.read(size))
    return torch.frombuffer(content, dtype=_TORCH[stored.dtype]).view(stored.shape)


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
    """Write a safetensors file. Widest dtypes come first, as the format wants it for alignment.

    Raises ValueError for a tensor that holds NaN or infinity.
    """
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
            _write(file, name, tensors[name], sizes[name])


def total_size(tensors: Mapping[str, StoredTensor | Zeros | torch.Tensor]) -> int:
    """Bytes of the tensors."""
    return sum(map(_size, tensors.values()))


def _dtype(tensor: StoredTensor | Zeros | torch.Tensor) -> str:
    return _DTYPES[tensor.dtype] if isinstance(tensor, torch.Tensor) else tensor.dtype


def _size(tensor: StoredTensor | Zeros | torch.Tensor) -> int:
    return torch.Size(tensor.shape).numel() * _BYTES[_dtype(tensor)]


def _write(file: BinaryIO, name: str, tensor: StoredTensor | Zeros | torch.Tensor, size: int) -> None:
    if isinstance(tensor, torch.Tensor):
        file.write(tensor.detach().contiguous().flatten().view(torch.uint8).numpy().tobytes())
        return
    step = _CHUNK * _BYTES[tensor.dtype]
    lengths = [min(step, size - begin) for begin in range(0, size, step)]
    if isinstance(tensor, Zeros):
        for length in lengths:
            file.write(bytes(length))
        return
    with tensor.path.open("rb") as source:
        source.seek(tensor.start)
        for length in lengths:
            content = bytearray(source.read(length))
            if not torch.frombuffer(content, dtype=_TORCH[tensor.dtype]).isfinite().all():
                raise ValueError(
                    f"Checkpoint {tensor.path} has NaN or infinity in {name}: its training had failed before it was saved; "
                    "choose an earlier one. Nothing was written."
                )
            file.write(content)
