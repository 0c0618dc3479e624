"""openpi's frames: one msgpack map each, arrays as `{__ndarray__: true, data, dtype, shape}`.

Facts of the format: https://github.com/Physical-Intelligence/openpi, packages/openpi-client (its keys of arrays are msgpack
binaries; a client in another language may send strings). A frame is walked once without building anything, which bounds its
values, their nesting and the length of every string; msgpack decodes it only then. dtypes are looked up in a list, never parsed.
"""

import struct
from math import prod
from typing import Any

import msgpack
import numpy as np

from .limits import Limits, RequestError

# Little-endian numbers. No objects, no structures, no text: numpy would run code or read beyond the data for those.
DTYPES = {dtype.str: dtype for dtype in map(np.dtype, ("u1", "<u2", "<f4", "<f8", "<i4", "<i8", "?"))}

_ARRAY = frozenset({"__ndarray__", "data", "dtype", "shape"})
_SCALAR = frozenset({"__npgeneric__", "data", "dtype"})
# First byte of a value whose length follows in a field: struct format of the field, and what the length counts.
_BYTES = {0xC4: ">B", 0xC5: ">H", 0xC6: ">I"}
_TEXT = {0xD9: ">B", 0xDA: ">H", 0xDB: ">I"}
_LISTS = {0xDC: ">H", 0xDD: ">I"}
_MAPS = {0xDE: ">H", 0xDF: ">I"}
# First byte of a number, nil or boolean: how many bytes follow.
_FIXED = {0xC0: 0, 0xC2: 0, 0xC3: 0, 0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8} | {
    0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8
}  # fmt: skip


def encode(message: dict[str, Any]) -> bytes:
    """A frame from a map of strings, numbers, booleans, None, lists, maps and arrays of `DTYPES`."""
    frame: bytes = msgpack.packb(message, default=_pack)
    return frame


def decode(frame: bytes, limits: Limits) -> dict[str, Any]:
    """The map in a frame, with read-only arrays. Raises RequestError. Allocates no more than some times the frame's size."""
    if len(frame) > limits.frame_bytes:
        raise RequestError(f"The frame has {len(frame)} bytes; at most {limits.frame_bytes} are accepted.")
    check_frame(frame, limits)
    try:
        message = msgpack.unpackb(frame, object_hook=_Unpack(limits), strict_map_key=True)
    except RequestError:
        raise
    except (ValueError, msgpack.UnpackException) as error:  # text that is no UTF-8, keys that are no text
        raise RequestError("The frame is no valid msgpack map with text keys.") from error
    if not isinstance(message, dict):
        raise RequestError(f"The frame holds a {type(message).__name__}; expected a map.")
    return message


def check_frame(frame: bytes, limits: Limits) -> None:
    """Raise RequestError unless a frame is one msgpack value within the limits. Builds nothing."""
    position, seen, end = 0, 0, len(frame)
    open_containers = [1]  # how many values are still to come in each
    while open_containers:
        if not open_containers[-1]:
            open_containers.pop()
            continue
        open_containers[-1] -= 1
        seen += 1
        if position >= end:
            raise RequestError("The frame ends within a value.")
        code = frame[position]
        position += 1
        inside = None  # values that a container holds
        if code <= 0x7F or code >= 0xE0:
            continue
        if code in _FIXED:
            position += _FIXED[code]
        elif 0xA0 <= code <= 0xBF:
            position += code & 0x1F
        elif code <= 0x8F:
            inside = 2 * (code & 0x0F)
        elif code <= 0x9F:
            inside = code & 0x0F
        else:
            length, position = _length(frame, code, position)
            if code in _MAPS or code in _LISTS:
                inside = 2 * length if code in _MAPS else length
            elif code in _TEXT and length > limits.text:
                raise RequestError(f"A text has {length} bytes; at most {limits.text} are accepted.")
            else:
                position += length
        if position > end:
            raise RequestError("The frame ends within a value.")
        if inside is not None:
            if seen + sum(open_containers) + inside > limits.values:
                raise RequestError(f"The frame holds more than {limits.values} values.")
            if len(open_containers) > limits.depth:
                raise RequestError(f"The frame is nested more than {limits.depth} deep.")
            open_containers.append(inside)
    if position != end:
        raise RequestError(f"{end - position} bytes follow the frame's map.")


def _length(frame: bytes, code: int, position: int) -> tuple[int, int]:
    """The length field at a position, and the position behind it."""
    field = _BYTES.get(code) or _TEXT.get(code) or _LISTS.get(code) or _MAPS.get(code)
    if field is None:
        raise RequestError(f"The frame has a value of msgpack type 0x{code:02x}; extension types are not accepted.")
    size = struct.calcsize(field)
    if position + size > len(frame):
        raise RequestError("The frame ends within a value.")
    return struct.unpack_from(field, frame, position)[0], position + size


class _Unpack:
    """msgpack calls this with every map; those that stand for an array or a numpy number become one."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._arrays = 0

    def __call__(self, found: dict[Any, Any]) -> Any:
        if len(found) not in (len(_ARRAY), len(_SCALAR)):
            return found
        named = {key.decode("latin-1") if isinstance(key, bytes) else key: value for key, value in found.items()}
        if named.keys() == _ARRAY:
            return self._array(named)
        if named.keys() == _SCALAR:
            _dtype(named["dtype"])
            if not isinstance(named["data"], int | float):
                raise RequestError("A numpy number holds no number.")
            return named["data"]
        return found

    def _array(self, named: dict[str, Any]) -> np.ndarray:
        self._arrays += 1
        if self._arrays > self._limits.arrays:
            raise RequestError(f"The frame holds more than {self._limits.arrays} arrays.")
        dtype, shape, data = _dtype(named["dtype"]), named["shape"], named["data"]
        if not isinstance(shape, list) or len(shape) > self._limits.dimensions:
            raise RequestError(f"The shape of an array must be a list of at most {self._limits.dimensions} numbers.")
        if not all(type(size) is int and 0 < size < 2**31 for size in shape):
            raise RequestError("The shape of an array must hold sizes of 1 and more.")
        if not isinstance(data, bytes) or len(data) != prod(shape) * dtype.itemsize:
            held = len(data) if isinstance(data, bytes) else "no"
            raise RequestError(f"An array of shape {tuple(shape)} and dtype {dtype.str} holds {held} bytes.")
        return np.frombuffer(data, dtype).reshape(shape)


def _dtype(given: Any) -> np.dtype:
    name = given.decode("latin-1") if isinstance(given, bytes) else given
    if not isinstance(name, str) or name not in DTYPES:
        raise RequestError(f"An array has a dtype that is not accepted; use one of {', '.join(DTYPES)}.")
    return DTYPES[name]


def _pack(value: Any) -> Any:
    """What msgpack does not know. Raises TypeError for what has no place on the wire."""
    if isinstance(value, np.ndarray) and value.dtype.str in DTYPES:
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": list(value.shape),
        }
    if isinstance(value, np.generic) and value.dtype.str in DTYPES:
        return value.item()
    raise TypeError(f"A {type(value).__name__} cannot be sent.")
