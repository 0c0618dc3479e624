"""Tensors inside a robot_client's pickles: a storage saved by torch as bytes, and a view of it.

torch reads such bytes back with `torch.load(weights_only=False)`, which runs code. Here their declared size is compared with the
bytes that are there, before `torch.load(weights_only=True)` allocates it.
"""

import io
import pickletools
from math import prod
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch

from ..limits import RequestError

# torch's format before zip files: pickles of a magic number, a version, the machine, the storage and its key, then the data.
_MAGIC = bytes.fromhex("80028a0a6cfc9c46f9206aa850192e")
_ITEMSIZE = {
    "FloatStorage": 4, "DoubleStorage": 8, "HalfStorage": 2, "LongStorage": 8, "IntStorage": 4, "ShortStorage": 2,
    "ByteStorage": 1, "BoolStorage": 1, "UInt16Storage": 2,
}  # fmt: skip
_MAX_OPCODES = 200


class Storage(NamedTuple):
    """The numbers of a storage, one-dimensional."""

    values: torch.Tensor


def read_storage(data: Any) -> Storage:
    """Raises RequestError for anything but one plain storage of the size that it declares."""
    if not isinstance(data, bytes | bytearray) or not data.startswith(_MAGIC):
        raise RequestError("The message has a tensor that is not saved as torch saves one.")
    try:
        declared = _declared_bytes(bytes(data))
        if declared > len(data):
            raise RequestError(f"The message has a tensor of {declared} bytes in {len(data)} bytes.")
        found = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except RequestError:
        raise
    except (
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        RuntimeError,
        EOFError,
        UnpicklingError,
        AttributeError,
    ) as error:
        raise RequestError("The message has a tensor that is not saved as torch saves one.") from error
    if not isinstance(found, torch.storage.TypedStorage):
        raise RequestError("The message has a tensor that is not saved as torch saves one.")
    return Storage(torch.tensor([], dtype=found.dtype).set_(found.untyped()))


def _declared_bytes(data: bytes) -> int:
    """How large the storage says that it is."""
    stream = io.BytesIO(data)
    for _ in range(3):  # magic number, version, machine
        for _ in _opcodes(stream):
            pass
    kinds = [argument for name, argument in _opcodes(stream) if name == "GLOBAL"]
    stream.seek(0)
    for _ in range(3):
        for _ in _opcodes(stream):
            pass
    numbers = [argument for _, argument in _opcodes(stream) if type(argument) is int]
    (kind,) = kinds
    module, name = kind.split(" ")
    if module != "torch":
        raise ValueError("no storage of torch")
    # Positions in the memo are numbers too, and small; the number of elements is not below any of the others.
    return max(numbers) * _ITEMSIZE[name]


def _opcodes(stream: io.BytesIO) -> list[tuple[str, Any]]:
    found = []
    for opcode, argument, _ in pickletools.genops(stream):
        found.append((opcode.name, argument))
        if len(found) > _MAX_OPCODES:
            raise ValueError("too many opcodes")
    return found


def rebuild_tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> np.ndarray:
    """A tensor as an array. Raises RequestError for a view that leaves its storage or repeats it."""
    shapes = type(size) is tuple and type(stride) is tuple and len(size) == len(stride) <= 4
    whole = shapes and all(type(n) is int for n in (offset, *size, *stride))
    if not isinstance(storage, Storage) or not whole or min((1, *size)) < 1 or min((offset, *stride)) < 0:
        raise RequestError("The message has a tensor that is not built as torch does.")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if prod(size) > len(storage.values) or last >= len(storage.values):
        raise RequestError("The message has a tensor that is larger than its data.")
    return storage.values.as_strided(size, stride, offset).contiguous().numpy()
