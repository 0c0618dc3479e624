"""openpi's frames: what goes in comes out, and what is hostile does not."""

import contextlib
import struct
import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lerobot_policy_pi05_geometry.serving.limits import MIB, Limits, RequestError
from lerobot_policy_pi05_geometry.serving.wire import DTYPES, decode, encode

from .running import make_request

LIMITS = Limits()
ARRAY = {b"__ndarray__": True, b"data": b"\0" * 12, b"dtype": "<f4", b"shape": [3]}

arrays = hnp.arrays(st.sampled_from(list(DTYPES.values())), hnp.array_shapes(min_dims=0, max_dims=4, max_side=4))
values = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(max_size=20), arrays
)
messages = st.dictionaries(
    st.text(max_size=8),
    st.recursive(
        values,
        lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
        max_leaves=12,
    ),
    max_size=5,
)


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and (a == b or a != a)


@settings(max_examples=30)
@given(messages)
def test_what_is_encoded_is_decoded(message):
    assert same(decode(encode(message), LIMITS), message)


def test_arrays_of_a_client_that_sends_text_keys():
    frame = msgpack.packb({"a": {key.decode(): value for key, value in ARRAY.items()}})
    assert same(decode(frame, LIMITS), {"a": np.zeros(3, np.float32)})


def test_numpy_numbers_become_numbers():
    frame = msgpack.packb({"a": {b"__npgeneric__": True, b"data": 1.5, b"dtype": "<f4"}})
    assert decode(frame, LIMITS) == {"a": 1.5}


def nested(depth: int) -> bytes:
    return b"\x81\xa1a" * depth + b"\xc0"


def rest_after(depth: int, count: int) -> bytes:
    """Each list begins with the next one, so all are open before the first one's other values are seen."""
    inner: list = []
    for _ in range(depth):
        inner = [inner] + [0] * count
    return msgpack.packb({"a": inner})


HOSTILE = {
    "empty": (b"", "ends within a value"),
    "a number": (b"\x05", "holds a int; expected a map"),
    "a list": (b"\x91\x05", "holds a list; expected a map"),
    "an array alone": (msgpack.packb(ARRAY), "holds a ndarray; expected a map"),
    "cut off": (msgpack.packb({"a": ARRAY})[:-1], "ends within a value"),
    "cut off in a length": (b"\x81\xa1a\xc6\0\0", "ends within a value"),
    "two maps": (b"\x80\x80", "1 bytes follow"),
    "a list of 4 billion": (b"\x81\xa1a\xdd\xff\xff\xff\xff", "more than 4096 values"),
    "a map of 4 billion": (b"\xdf\xff\xff\xff\xff", "more than 4096 values"),
    "a million nothings": (b"\x81\xa1a\xdd" + struct.pack(">I", 10**6) + b"\xc0" * 10**6, "more than 4096 values"),
    "lists whose rest comes after what is in them": (rest_after(6, 4000), "more than 4096 values"),
    "binary of 4 GiB": (b"\x81\xa1a\xc6\xff\xff\xff\xff" + b"x", "ends within a value"),
    "text of 4 GiB": (b"\x81\xa1a\xdb\xff\xff\xff\xffx", "text has 4294967295 bytes"),
    "long text": (msgpack.packb({"a": "x" * 5000}), "text has 5000 bytes; at most 4096"),
    "nested": (nested(9), "nested more than 8 deep"),
    "nested very deep": (nested(4000), "values|nested more than 8 deep"),
    "an extension": (msgpack.packb({"a": msgpack.ExtType(5, b"x")}), "extension types are not accepted"),
    "a time": (b"\x81\xa1a\xd6\xff\0\0\0\0", "extension types are not accepted"),
    "the unused type": (b"\x81\xa1a\xc1", "type 0xc1"),
    "a number as key": (b"\x81\x01\x02", "text keys"),
    "a list as key": (b"\x81\x91\x01\x02", "text keys"),
    "text that is no UTF-8": (b"\x81\xa1\xff\xc0", "text keys"),
    "objects": (msgpack.packb({"a": ARRAY | {b"dtype": "|O"}}), "dtype that is not accepted"),
    "structures": (msgpack.packb({"a": ARRAY | {b"dtype": "f4,O"}}), "dtype that is not accepted"),
    "text arrays": (msgpack.packb({"a": ARRAY | {b"dtype": "<U3"}}), "dtype that is not accepted"),
    "a dtype that is a list": (msgpack.packb({"a": ARRAY | {b"dtype": ["<f4"]}}), "dtype that is not accepted"),
    "big-endian": (msgpack.packb({"a": ARRAY | {b"dtype": ">f4"}}), "dtype that is not accepted"),
    "a shape too large": (msgpack.packb({"a": ARRAY | {b"shape": [2**31 - 1] * 4}}), "holds 12 bytes"),
    "a shape too small": (msgpack.packb({"a": ARRAY | {b"shape": [2]}}), "holds 12 bytes"),
    "a negative shape": (msgpack.packb({"a": ARRAY | {b"shape": [-1, -3]}}), "must hold sizes"),
    "an empty shape": (msgpack.packb({"a": ARRAY | {b"shape": [0, 2**31 - 1]}}), "must hold sizes"),
    "a boolean shape": (msgpack.packb({"a": ARRAY | {b"shape": [True, 3]}}), "must hold sizes"),
    "a shape of text": (msgpack.packb({"a": ARRAY | {b"shape": "3"}}), "must be a list"),
    "five dimensions": (msgpack.packb({"a": ARRAY | {b"shape": [3, 1, 1, 1, 1]}}), "at most 4"),
    "data that is text": (msgpack.packb({"a": ARRAY | {b"data": "x" * 12}}), "holds no bytes"),
    "a number of text": (
        msgpack.packb({"a": {b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"}}), "holds no number"
    ),
    "many arrays": (msgpack.packb({str(i): ARRAY for i in range(65)}), "more than 64 arrays"),
    "too large": (b"\x81\xa1a\xc6" + struct.pack(">I", 33 * MIB) + b"\0" * 33 * MIB, "bytes; at most"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_frame_is_refused_in_one_sentence_before_anything_is_allocated(name):
    frame, sentence = HOSTILE[name]
    tracemalloc.start()
    try:
        with pytest.raises(RequestError, match=sentence) as caught:
            decode(frame, LIMITS)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < len(frame) + MIB
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [object(), np.array([object()]), np.array(["a"]), 1 + 2j, {1, 2}, np.zeros(2, ">f4")])
def test_what_has_no_place_on_the_wire_is_not_sent(value):
    with pytest.raises(TypeError, match="cannot be sent"):
        encode({"a": value})


def mutated(frame: bytes, random: np.random.Generator) -> bytes:
    """A real frame with bytes changed, cut, inserted, repeated or two parts exchanged."""
    changed = bytearray(frame)
    for _ in range(int(random.integers(1, 6))):
        # Mostly where structure is: the first bytes and the last; pixels are only pixels.
        spread = int(random.choice([64, 400, len(changed)]))
        at = int(random.integers(0, max(1, min(spread, len(changed)))))
        if random.random() < 0.3:
            at = max(0, len(changed) - 1 - at)
        match int(random.integers(0, 6)):
            case 0:
                changed[at : at + 1] = random.bytes(1)
            case 1:
                del changed[at:]
            case 2:
                changed[at:at] = random.bytes(int(random.integers(1, 9)))
            case 3:
                changed[at : at + 1] = bytes(
                    [int(random.choice([0xC4, 0xC6, 0xC9, 0xDB, 0xDD, 0xDF, 0x9F, 0x8F, 0xC1]))]
                )
            case 4:
                changed += changed[at : at + 50]
            case _:
                changed[at : at + 4] = b"\xff\xff\xff\xff"
        if not changed:
            return b""
    return bytes(changed)


def attack(frames: int) -> tuple[int, int]:
    """Decode mutations of a real frame and noise. Returns how many were refused, and the most that was allocated, in bytes."""
    random = np.random.default_rng(0)
    real = encode(make_request() | {"inference_delay": 2, "executed_steps": 3, "endpoint": "infer"})
    refused = 0
    tracemalloc.start()
    try:
        for i in range(frames):
            frame = mutated(real, random) if i % 4 else random.bytes(int(random.integers(0, 200)))
            try:
                assert isinstance(decode(frame, LIMITS), dict)
            except RequestError:
                refused += 1
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return refused, peak


def test_mutated_frames_are_decoded_or_refused():
    refused, peak = attack(1_000)
    assert 300 < refused < 1_000
    assert peak < 2 * MIB  # the frame has 20 KiB


@pytest.mark.long
def test_a_hundred_thousand_mutated_frames():
    refused, peak = attack(100_000)
    assert 30_000 < refused < 100_000
    assert peak < 2 * MIB


@settings(max_examples=100)
@given(st.binary(max_size=64))
def test_bytes_are_decoded_or_refused(frame):
    with contextlib.suppress(RequestError):
        assert isinstance(decode(frame, LIMITS), dict)
