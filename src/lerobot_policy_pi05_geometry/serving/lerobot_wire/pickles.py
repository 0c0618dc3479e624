"""A pickle of LeRobot's robot_client, read without running anything.

`pickle.loads` calls whatever a message names (CVE-2026-25874). This interprets the opcodes itself, and knows only those that the
client's messages consist of: numbers, text, bytes, lists, tuples, maps with text keys, and calls of the names in a short list,
each of which stands for a function of this file that checks its arguments and makes plain data. Everything else is refused before
it is run:

- other names (`os.system`), and other ways to name or call something (GLOBAL, INST, OBJ, NEWOBJ_EX, EXT, persistent ids);
- memo entries at a place of the message's choosing (PUT, BINPUT, LONG_BINPUT): twenty bytes can claim one at two billion, for
  which the C unpickler allocates gigabytes. Entries are only ever appended (MEMOIZE);
- map keys that are no text: hashing a tuple of tuples of the same tuple takes forever;
- arrays whose bytes are not exactly what shape and dtype say, and more of them than a message can hold.

Opcodes of protocol 4 and 5 (Python 3.8 to 3.14 write one of them): https://github.com/python/cpython/blob/main/Lib/pickletools.py
"""

import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np

from ..limits import Limits, RequestError, shown
from .torch_storage import Storage, read_storage, rebuild_tensor

MAX_OPCODES = 20_000  # an observation has some 200, instructions for a robot with 50 joints some 1,000
MAX_DIMENSIONS = 4

_DTYPES = {name: np.dtype(name) for name in ("u1", "u2", "i2", "i4", "i8", "f2", "f4", "f8", "b1")}
_ORDERS = ("<", "|", "=")


class PickleRefusedError(RequestError):
    """A pickle with something in it that no robot_client sends."""


@dataclass
class Instance:
    """An object of one of LeRobot's classes: its name, and its fields as plain data."""

    name: str
    fields: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Name:
    """A name that the message may use."""

    name: str


@dataclass
class Array:
    """An array that is being built; numpy makes it empty first, and fills it later."""

    value: np.ndarray | None = None


_MARK = object()


def read_pickle(message: bytes, limits: Limits) -> Any:
    """The plain data in a message. Raises PickleRefusedError for anything that a robot_client does not send."""
    if len(message) > limits.frame_bytes:
        raise PickleRefusedError(f"The message has {len(message)} bytes; at most {limits.frame_bytes} are accepted.")
    machine = _Machine(limits.frame_bytes)
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(message)):
            if count >= MAX_OPCODES:
                raise PickleRefusedError(f"The message has more than {MAX_OPCODES} opcodes.")
            act = _ACTS.get(opcode.name)
            if act is None:
                raise PickleRefusedError(f"The message has the opcode {opcode.name}, which no robot_client writes.")
            act(machine, argument)
        found = machine.pop()
        if machine.stack:
            raise ValueError("there is more than one value")
    except RequestError:
        raise
    except (
        ValueError,
        IndexError,
        TypeError,
        KeyError,
        OverflowError,
        RuntimeError,
    ) as error:  # opcodes that fit nothing before them
        raise PickleRefusedError("The message is no pickle as a robot_client writes it.") from error
    return found


class _Machine:
    """The stack and the memo of the opcodes. room: bytes that all arrays may have together."""

    def __init__(self, room: int) -> None:
        self.stack: list[Any] = []
        self.memo: list[Any] = []
        self._room = room

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def pop(self) -> Any:
        value = self.stack.pop()
        if value is _MARK:
            raise ValueError("a mark is no value")
        return value

    def pop_to_mark(self) -> list[Any]:
        items: list[Any] = []
        while (value := self.stack.pop()) is not _MARK:
            items.append(value)
        return items[::-1]

    def top(self, kind: type) -> Any:
        value = self.stack[-1]
        if type(value) is not kind:
            raise ValueError("the value below is of another kind")
        return value

    def set_items(self, items: list[Any]) -> None:
        found = self.top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            if type(key) is not str:
                raise PickleRefusedError("The message has a map with a key that is no text.")
            found[key] = value

    def name(self) -> None:
        name, module = self.pop(), self.pop()
        full = f"{module}.{name}" if type(name) is type(module) is str else ""
        if full not in _CALLS and full not in _CLASSES and full not in _VALUES:
            what = shown(full) if full else "something"
            raise PickleRefusedError(f"The message names {what}, which is none of what a robot_client sends.")
        self.push(_Name(full))

    def call(self) -> None:
        arguments, name = self.pop(), self.pop()
        if type(name) is not _Name or type(arguments) is not tuple or name.name not in _CALLS:
            raise PickleRefusedError("The message calls something that cannot be called.")
        made = _CALLS[name.name](*arguments)
        # A message may name the same bytes a thousand times, and each time they are read.
        self._room -= max(_bytes_of(made), sum(len(a) for a in arguments if isinstance(a, bytes | bytearray)))
        if self._room < 0:
            raise PickleRefusedError("The message makes more of its bytes than it has.")
        self.push(made)

    def make(self) -> None:
        arguments, name = self.pop(), self.pop()
        if type(name) is not _Name or name.name not in _CLASSES or arguments != ():
            raise PickleRefusedError("The message makes an object of a class that no robot_client sends.")
        self.push(Instance(name.name.rpartition(".")[2]))

    def build(self) -> None:
        state, made = self.pop(), self.stack[-1]
        if type(made) is Instance and type(state) is dict:
            made.fields.update(state)
        elif type(made) is Array and type(state) is tuple:
            _fill(made, *state)
        elif not (type(made) is np.dtype or isinstance(made, np.dtype)) or not _is_plain(state):
            raise PickleRefusedError("The message changes something that it may not.")


def _bytes_of(made: Any) -> int:
    if type(made) is Storage:
        return made.values.nbytes
    return made.value.nbytes if type(made) is Array and made.value is not None else 0


def _text(machine: _Machine, text: str) -> None:
    text.encode()  # half a surrogate pair is no text, and raises
    machine.push(text)


def _is_plain(state: Any) -> bool:
    """The state of a dtype without fields: version, byte order, and nothing of structures."""
    return type(state) is tuple and len(state) == 8 and state[1] in _ORDERS and state[2:5] == (None, None, None)


# --- what names stand for -----------------------------------------------------------------------------------------


def _dtype(name: Any, align: Any = False, copy: Any = True) -> np.dtype:
    known = _DTYPES.get(name.lstrip("<|=")) if type(name) is str else None
    if known is None:
        raise PickleRefusedError("The message has an array of a dtype that is not accepted.")
    return known


def _reconstruct(kind: Any, shape: Any, typecode: Any) -> Array:
    if kind != _Name("numpy.ndarray") or shape != (0,):
        raise PickleRefusedError("The message has an array that is not built as numpy does.")
    return Array()


def _fill(array: Array, version: Any, shape: Any, dtype: Any, fortran: Any, data: Any) -> None:
    if array.value is not None:
        raise PickleRefusedError("The message fills an array twice.")
    array.value = _array(data, dtype, shape, "F" if fortran is True else "C")


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any, *axes: Any) -> Array:
    if axes not in ((), (None,)):
        raise PickleRefusedError("The message has an array with its axes in an unusual order.")
    return Array(_array(data, dtype, shape, order))


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    sizes = type(shape) is tuple and len(shape) <= MAX_DIMENSIONS and all(type(n) is int and n > 0 for n in shape)
    if (
        not sizes
        or not isinstance(dtype, np.dtype)
        or not isinstance(data, bytes | bytearray)
        or order not in ("C", "F")
    ):
        raise PickleRefusedError("The message has an array that is not built as numpy does.")
    if prod(shape) * dtype.itemsize != len(data):
        raise PickleRefusedError(f"The message has an array of shape {shape} and dtype {dtype} with {len(data)} bytes.")
    return np.frombuffer(data, dtype).reshape(shape, order=order)


def _scalar(dtype: Any, data: Any) -> float | int | bool:
    number: float | int | bool = _array(data, dtype, (), "C").item()
    return number


def _storage(data: Any) -> Storage:
    return read_storage(data)


def _tensor(*arguments: Any) -> Array:
    return Array(rebuild_tensor(*arguments))


_HELPERS = "lerobot.async_inference.helpers"
_CLASSES = {f"{_HELPERS}.{name}" for name in ("RemotePolicyConfig", "TimedObservation")}
_VALUES = {"numpy.ndarray"}
_CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _dtype,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch.storage._load_from_bytes": _storage,
    "collections.OrderedDict": lambda: {},
}
for _core in ("numpy.core", "numpy._core"):  # numpy 1 and 2
    _CALLS[f"{_core}.multiarray._reconstruct"] = _reconstruct
    _CALLS[f"{_core}.multiarray.scalar"] = _scalar
    _CALLS[f"{_core}.numeric._frombuffer"] = _frombuffer


# --- opcodes ------------------------------------------------------------------------------------------------------


def _tuple_of(count: int) -> Callable[[_Machine, Any], None]:
    def act(machine: _Machine, _: Any) -> None:
        machine.push(tuple([machine.pop() for _ in range(count)][::-1]))

    return act


def _set_item(machine: _Machine, _: Any) -> None:
    value, key = machine.pop(), machine.pop()
    machine.set_items([key, value])


def _append(machine: _Machine, _: Any) -> None:
    value = machine.pop()
    machine.top(list).append(value)


def _append_all(machine: _Machine, _: Any) -> None:
    items = machine.pop_to_mark()
    machine.top(list).extend(items)


def _nothing(machine: _Machine, _: Any) -> None: ...


_ACTS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), _nothing),
    **dict.fromkeys(
        (
            "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "SHORT_BINBYTES", "BINBYTES",
            "BINBYTES8", "BYTEARRAY8",
        ),
        lambda machine, argument: machine.push(argument),
    ),
    **dict.fromkeys(("SHORT_BINUNICODE", "BINUNICODE"), _text),
    "MARK": lambda machine, _: machine.push(_MARK),
    "NONE": lambda machine, _: machine.push(None),
    "NEWTRUE": lambda machine, _: machine.push(True),
    "NEWFALSE": lambda machine, _: machine.push(False),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "TUPLE1": _tuple_of(1),
    "TUPLE2": _tuple_of(2),
    "TUPLE3": _tuple_of(3),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.pop_to_mark())),
    "APPEND": _append,
    "APPENDS": _append_all,
    "SETITEM": _set_item,
    "SETITEMS": lambda machine, _: machine.set_items(machine.pop_to_mark()),
    "MEMOIZE": lambda machine, _: machine.memo.append(machine.stack[-1]),
    "BINGET": lambda machine, argument: machine.push(machine.memo[argument]),
    "LONG_BINGET": lambda machine, argument: machine.push(machine.memo[argument]),
    "STACK_GLOBAL": lambda machine, _: machine.name(),
    "REDUCE": lambda machine, _: machine.call(),
    "NEWOBJ": lambda machine, _: machine.make(),
    "BUILD": lambda machine, _: machine.build(),
}  # fmt: skip
