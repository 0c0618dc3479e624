"""The pickles of robot_client: read like pickle reads them, and nothing in them is ever run."""

import contextlib
import io
import os
import pickle
import pickletools
import struct
import tracemalloc
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation

from lerobot_policy_pi05_geometry.serving.lerobot_wire.pickles import Array, Instance, read_pickle
from lerobot_policy_pi05_geometry.serving.limits import MIB, Limits, RequestError

LIMITS = Limits()


def plain(value):
    """Arrays as they are, objects as maps."""
    if isinstance(value, Array):
        return value.value
    if isinstance(value, Instance):
        return {name: plain(found) for name, found in value.fields.items()}
    if isinstance(value, dict):
        return {name: plain(found) for name, found in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(plain, value))
    return value


def observation(**more) -> TimedObservation:
    random = np.random.default_rng(0)
    values = {
        "joint.pos": 0.5, "count": 3, "on": True, "task": "push µ", "nothing": None,
        "front": random.integers(0, 256, (30, 40, 3), dtype=np.uint8),
        "front_depth": random.integers(0, 2000, (18, 24, 1), dtype=np.uint16),
        "part": random.standard_normal((6, 8))[::2, 1:].astype(np.float32),
        "columns": np.asfortranarray(random.standard_normal((3, 4))),
        "number": np.float32(2.5), "whole": np.int64(-3),
        "tensor": torch.arange(12.0).reshape(3, 4)[:, 1:], "bytes": torch.arange(5, dtype=torch.uint8), "same": None,
    }  # fmt: skip
    return TimedObservation(12.5, 7, values | {"same": values["front"]} | more, True)


def instructions() -> RemotePolicyConfig:
    features = {
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
        "observation.images.front": {"dtype": "image", "shape": (30, 40, 3), "names": ["height", "width", "channels"]},
    }
    return RemotePolicyConfig("act", "user/model", features, 50, "cuda", {"a": "b"})


@pytest.mark.parametrize("protocol", [4, 5])
def test_what_a_robot_client_sends_is_read_as_pickle_reads_it(protocol):
    found = read_pickle(pickle.dumps(observation(), protocol), LIMITS)
    assert found.name == "TimedObservation"
    fields = plain(found)
    assert (fields["timestamp"], fields["timestep"], fields["must_go"]) == (12.5, 7, True)
    for name, value in observation().observation.items():
        got = fields["observation"][name]
        if isinstance(value, np.ndarray | torch.Tensor):
            value = np.asarray(value)
            assert (got.dtype, got.shape) == (value.dtype, value.shape), name
            np.testing.assert_array_equal(got, value, err_msg=name)
        else:
            assert got == value, name
            assert type(got) is type(value) or isinstance(value, np.generic), name
    told = read_pickle(pickle.dumps(instructions(), protocol), LIMITS)
    assert told.name == "RemotePolicyConfig"
    assert plain(told) == vars(instructions())


class Calls:
    """Pickles as a call of something."""

    def __init__(self, function, *arguments, state=None):
        self.made = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self):
        return self.made


MARKER = Path("/tmp") / f"pi05_geometry_pickle_{os.getpid()}"


def touch() -> None:
    MARKER.touch()


def unpickling(state: bytes) -> bytes:
    return b"\x80\x04" + state + b"."


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def named(module: str, name: str) -> bytes:
    return text(module) + text(name) + b"\x93"


def storage(count: int, claim: int | None = None, kind: str = "FloatStorage") -> bytes:
    """What torch saves of a storage, with another size and type claimed."""
    stream = io.BytesIO()
    torch.save(torch.zeros(count).storage(), stream, _use_new_zipfile_serialization=False)
    saved = stream.getvalue().replace(b"FloatStorage", kind.encode())
    if claim is None:
        return saved
    at = saved.index(b"X\x03\0\0\0cpuq\x03") + 10
    assert saved[at : at + 2] == b"K" + bytes([count])
    return saved[:at] + b"J" + struct.pack("<i", claim) + saved[at + 2 :]


def zipped() -> bytes:
    stream = io.BytesIO()
    torch.save(torch.zeros(3), stream)
    return stream.getvalue()


LOAD = torch.storage._load_from_bytes
VIEW = torch._utils._rebuild_tensor_v2
tensors = [  # (storage, offset, size, stride)
    (Calls(LOAD, storage(3)), 0, (4,), (1,)),
    (Calls(LOAD, storage(3)), 3, (1,), (1,)),
    (Calls(LOAD, storage(3)), -1, (1,), (1,)),
    (Calls(LOAD, storage(3)), 0, (10**9,), (0,)),
    (Calls(LOAD, storage(3)), 0, (3,), (-1,)),
    (Calls(LOAD, storage(3)), 0, (3,), (1, 1)),
    (Calls(LOAD, storage(3)), 0, [3], [1]),
    (b"123456789012", 0, (3,), (1,)),
]
RECONSTRUCT = (np._core.multiarray._reconstruct, np.ndarray, (0,), b"b")
HOSTILE = {
    "a system call": pickle.dumps(Calls(os.system, f"touch {MARKER}")),
    "a system call, protocol 0": pickle.dumps(Calls(os.system, f"touch {MARKER}"), 0),
    "a system call, protocol 2": pickle.dumps(Calls(os.system, f"touch {MARKER}"), 2),
    "inside an observation": pickle.dumps(observation(joint=Calls(os.system, f"touch {MARKER}"))),
    "inside a tensor": pickle.dumps(Calls(LOAD, pickle.dumps(Calls(os.system, f"touch {MARKER}"), 2))),
    "inside a tensor, behind the magic number": pickle.dumps(
        Calls(LOAD, storage(1)[:15] + pickle.dumps(Calls(os.system, f"touch {MARKER}"), 2))
    ),
    "in place of a storage": pickle.dumps(
        Calls(LOAD, storage(1)[: storage(1).index(b"\x80\x02(X")] + pickle.dumps(Calls(os.system, f"touch {MARKER}"), 2))
    ),
    "in place of the machine": pickle.dumps(
        Calls(
            LOAD,
            storage(1)[:21]
            + pickle.dumps(Calls(os.system, f"touch {MARKER}"), 2)
            + storage(1)[storage(1).index(b"\x80\x02(X") :],
        )
    ),
    "an array filled twice": pickle.dumps(np.zeros(3, np.uint8), 4)[:-1]
    + pickle.dumps((1, (3,), np.dtype("u1"), False, b"123"), 4)[11:-1]
    + b"b.",
    "a function of ours": pickle.dumps(Calls(touch)),
    "eval": pickle.dumps(Calls(eval, "1")),
    "getattr": unpickling(named("builtins", "getattr")),
    "import": unpickling(named("importlib", "import_module") + text("os") + b"\x85R"),
    "a name with dots": unpickling(named("numpy", "ndarray.__class__")),
    "pickle itself": unpickling(named("_pickle", "loads")),
    "numpy's own pickle": unpickling(named("numpy", "load")),
    "torch.load": unpickling(named("torch", "load")),
    "a name that is a number": unpickling(b"K\x01K\x02\x93"),
    "GLOBAL": unpickling(b"cos\nsystem\n"),
    "INST": unpickling(b"(S'true'\nios\nsystem\n"),
    "OBJ": unpickling(b"(cos\nsystem\no"),
    "NEWOBJ_EX": unpickling(named("numpy", "ndarray") + b")}\x92"),
    "a persistent id": unpickling(b"K\x01Q"),
    "an extension": unpickling(b"\x82\x01"),
    "an out-of-band buffer": unpickling(b"\x97"),
    "another class": unpickling(named("pathlib", "Path") + b")\x81"),
    "a class called": unpickling(named("lerobot.async_inference.helpers", "TimedObservation") + b")R"),
    "an array made as a class": unpickling(named("numpy", "ndarray") + b")\x81"),
    "a class with arguments": unpickling(named("lerobot.async_inference.helpers", "TimedObservation") + b"K\x01\x85\x81"),
    "a name changed": unpickling(named("numpy", "ndarray") + b"}b"),
    "a list changed": unpickling(b"]}b"),
    "memo bomb": unpickling(b"Nr\xff\xff\xff\x7f"),
    "memo bomb in text": unpickling(b"Np2147483647\n"),
    "memo at a place": unpickling(b"Nq\x01"),
    "memo that is not there": unpickling(b"h\x05"),
    "bytes of 4 GiB": unpickling(b"B\xff\xff\xff\xffabc"),
    "bytes of 2**60": unpickling(b"\x8e" + struct.pack("<Q", 2**60) + b"abc"),
    "a byte array of 2**60": unpickling(b"\x96" + struct.pack("<Q", 2**60) + b"abc"),
    "text of 4 GiB": unpickling(b"X\xff\xff\xff\xffabc"),
    "half a surrogate pair": unpickling(b"X\x03\0\0\0\xed\xa0\x80"),
    "a number of 16 million digits": unpickling(b"\x8b" + struct.pack("<i", 2**30) + b"\x01"),
    "a tuple as key": unpickling(b"})Ns"),
    "tuples of tuples as key": unpickling(b"})\x94" + b"h\0h\0\x86\x94" * 60 + b"Ns"),
    "many opcodes": unpickling(b"]" + b"Na" * 20_000),
    "a deep list": unpickling(b"]" * 10_000 + b"a" * 9_999)[:30_000],
    "nothing": b"",
    "no end": b"\x80\x04N",
    "no value": unpickling(b""),
    "two values": unpickling(b"NN"),
    "a mark as value": unpickling(b"("),
    "a mark in a tuple": unpickling(b"N(\x86"),
    "an append to a number": unpickling(b"K\x01Na"),
    "items for a list": unpickling(b"](Nu"),
    "half an item": unpickling(b"}(Nu"),
    "objects in an array": pickle.dumps(np.array([object, 1], dtype=object)),
    "structures in an array": pickle.dumps(np.zeros(2, dtype="f4,f4")),
    "text in an array": pickle.dumps(np.array(["a"])),
    "dates in an array": pickle.dumps(np.zeros(2, dtype="M8[s]")),
    "big-endian": pickle.dumps(np.zeros(2, dtype=">f4")),
    "an array without bytes": pickle.dumps(Calls(*RECONSTRUCT, state=(1, (10**9,), np.dtype("u1"), False, b"1"))),
    "an array of objects by hand": pickle.dumps(
        Calls(*RECONSTRUCT, state=(1, (1,), np.dtype("O"), False, [os.system]))
    ),
    "an array with a negative side": pickle.dumps(
        Calls(*RECONSTRUCT, state=(1, (-1, -1), np.dtype("u1"), False, b"1"))
    ),
    "an array of five dimensions": pickle.dumps(np.zeros((1, 1, 1, 1, 1))),
    "an array of another class": pickle.dumps(Calls(np._core.multiarray._reconstruct, np.matrix, (0,), b"b")),
    "a map with contents": pickle.dumps(Calls(OrderedDict, [("a", 1)])),
    "a storage that claims more": pickle.dumps(Calls(LOAD, storage(3, claim=2**30))),
    "a storage that claims less than nothing": pickle.dumps(Calls(LOAD, storage(3, claim=-5))),
    "a storage of another kind": pickle.dumps(Calls(LOAD, storage(3, kind="QInt8Storage"))),
    "a tensor in a zip file": pickle.dumps(Calls(LOAD, zipped())),
    "a storage of text": pickle.dumps(Calls(LOAD, "x")),
    "half a storage": pickle.dumps(Calls(LOAD, storage(30)[:-60])),
    **{f"tensor {i}": pickle.dumps(Calls(VIEW, *made, False, OrderedDict())) for i, made in enumerate(tensors)},
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_pickle_is_refused_and_nothing_is_run(name):
    MARKER.unlink(missing_ok=True)
    tracemalloc.start()
    try:
        with pytest.raises(RequestError) as caught:
            read_pickle(HOSTILE[name], LIMITS)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert not MARKER.exists()
    assert peak < len(HOSTILE[name]) + 4 * MIB
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_the_hostile_pickles_are_hostile():
    """The system call in the list is one that pickle runs."""
    MARKER.unlink(missing_ok=True)
    pickle.loads(HOSTILE["a system call"])
    assert MARKER.exists()
    MARKER.unlink()


@pytest.mark.parametrize(("count", "rest"), [(200, b""), (1, b"x" * 1000)], ids=["large", "long"])
def test_one_storage_named_a_thousand_times_is_no_thousand_storages(count, rest):
    """Neither the memory of them, nor the time to read each."""
    stored = storage(count, claim=None) + rest
    name = named("torch.storage", "_load_from_bytes") + b"\x94"
    data = b"B" + struct.pack("<I", len(stored)) + stored + b"\x94"
    message = unpickling(b"]" + name + data + b"\x85\x94R" + b"a" + b"h\0h\2Ra" * 1000)
    limits = Limits(frame_bytes=100 * 1024)
    assert len(message) < limits.frame_bytes
    with pytest.raises(RequestError, match="makes more of its bytes than it has"):
        read_pickle(message, limits)


def test_a_storage_that_claims_more_is_refused_before_torch_allocates_it(monkeypatch):
    def allocate(*_, **__):
        raise AssertionError("torch.load was reached")

    monkeypatch.setattr(torch, "load", allocate)
    with pytest.raises(RequestError, match="a tensor of 4294967296 bytes in"):
        read_pickle(pickle.dumps(Calls(LOAD, storage(3, claim=2**30))), LIMITS)


def test_a_message_that_is_too_large():
    with pytest.raises(RequestError, match="at most 10 are accepted"):
        read_pickle(b"x" * 11, Limits(frame_bytes=10))


def mutated(message: bytes, random: np.random.Generator) -> bytes:
    """A real message with bytes changed where opcodes are; the rest is pixels."""
    changed, places = bytearray(message), PLACES[message]
    for _ in range(int(random.integers(1, 5))):
        at = int(random.choice(places)) + int(random.integers(0, 3))
        match int(random.integers(0, 5)):
            case 0:
                changed[at : at + 1] = random.bytes(1)
            case 1:
                changed[at:at] = random.bytes(int(random.integers(1, 6)))
            case 2:
                changed[at : at + 1] = bytes([int(random.choice(np.frombuffer(CODES, np.uint8)))])
            case 3:
                del changed[at : at + int(random.integers(1, 9))]
            case _:
                other = int(random.choice(places))
                changed[at:at] = message[other : other + int(random.integers(1, 12))]
    return bytes(changed)


CODES = bytes(ord(opcode.code) for opcode in pickletools.opcodes)
REAL = [pickle.dumps(message, protocol) for message in (observation(), instructions()) for protocol in (4, 5)]
PLACES = {message: [place for _, _, place in pickletools.genops(message)] for message in REAL}


def attack(messages: int) -> tuple[int, int]:
    """Read mutations of real messages and noise. Returns how many were refused, and the most that was allocated, in bytes."""
    random, refused = np.random.default_rng(0), 0
    MARKER.unlink(missing_ok=True)
    tracemalloc.start()
    try:
        for i in range(messages):
            message = (
                mutated(REAL[i % len(REAL)], random)
                if i % 5
                else b"\x80\x04" + random.bytes(int(random.integers(0, 99)))
            )
            try:
                read_pickle(message, LIMITS)
            except RequestError:
                refused += 1
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert not MARKER.exists()
    return refused, peak


def test_a_tensor_in_the_place_of_a_shape_is_refused():
    content = io.BytesIO()
    torch.save(torch.tensor([1.0, 2.0]).storage(), content, _use_new_zipfile_serialization=False)
    data = content.getvalue()

    def name(module: str, kind: str) -> bytes:
        return b"".join(b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, kind)) + b"\x93"

    storage = name("torch.storage", "_load_from_bytes") + b"B" + len(data).to_bytes(4, "little") + data + b"\x85R"
    array = name("numpy.core.multiarray", "_reconstruct") + name("numpy", "ndarray") + storage + b"C\x01b\x87R."
    with pytest.raises(RequestError):
        read_pickle(b"\x80\x04" + array, LIMITS)


def test_mutated_pickles_are_read_or_refused():
    refused, peak = attack(1_000)
    assert 500 < refused < 1_000
    assert peak < 4 * MIB


@pytest.mark.long
def test_a_hundred_thousand_mutated_pickles():
    refused, peak = attack(100_000)
    assert 50_000 < refused < 100_000
    assert peak < 4 * MIB


@settings(max_examples=100)
@given(st.lists(st.sampled_from(list(CODES)) | st.integers(0, 255), max_size=40))
def test_opcodes_in_any_order_are_read_or_refused(codes):
    with contextlib.suppress(RequestError):
        read_pickle(unpickling(bytes(codes)), LIMITS)
