"""Safetensors files written by hand are what the library writes."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lerobot_policy_pi05_geometry.checkpoint.conversion import tensor_file
from lerobot_policy_pi05_geometry.checkpoint.conversion.tensor_file import (
    Zeros,
    read_tensors,
    total_size,
    write_tensors,
)

DTYPES = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "I64": torch.int64}

shapes = st.lists(st.integers(0, 5), max_size=3).map(tuple)
entries = st.dictionaries(
    st.text(min_size=1, max_size=8), st.tuples(st.sampled_from(sorted(DTYPES)), shapes), max_size=6
)


def draw(entry: tuple[str, tuple[int, ...]], seed: int) -> torch.Tensor:
    return (100 * torch.randn(entry[1], generator=torch.Generator().manual_seed(seed))).to(DTYPES[entry[0]])


@given(entries, st.integers(1, 40))
def test_copied_tensors_are_equal_bit_for_bit(tmp_path_factory, contents, chunk):
    """Any names, shapes (empty and scalar too) and dtypes, in pieces of any size; renamed, repeated and left out."""
    folder = tmp_path_factory.mktemp("files")
    tensors = {name: draw(entry, seed) for seed, (name, entry) in enumerate(contents.items())}
    save_file(tensors, folder / "source")
    stored = read_tensors(folder / "source")
    assert {name: (t.dtype, t.shape) for name, t in stored.items()} == contents
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tensor_file, "_CHUNK", chunk)
        plan = {f"{name}.{copy}": tensor for name, tensor in stored.items() for copy in "ab"}
        write_tensors(folder / "copy", plan | {"zeros": Zeros("F32", (2, 3)), "step": torch.tensor(7)})
    found = load_file(folder / "copy")
    assert torch.equal(found.pop("zeros"), torch.zeros(2, 3))
    assert torch.equal(found.pop("step"), torch.tensor(7))
    assert found.keys() == plan.keys()
    for name, tensor in found.items():
        original = tensors[name[:-2]]
        assert tensor.dtype == original.dtype
        assert torch.equal(tensor, original)
    assert total_size(plan) == sum(2 * t.numel() * t.element_size() for t in tensors.values())


def test_a_file_that_is_there_is_not_overwritten(tmp_path):
    (tmp_path / "there").write_text("something")
    with pytest.raises(FileExistsError):
        write_tensors(tmp_path / "there", {})
    assert (tmp_path / "there").read_text() == "something"


def test_tensors_are_aligned_for_readers_that_map_the_file(tmp_path):
    tensors = {"a": torch.zeros(3, dtype=torch.bfloat16), "b": torch.zeros(3), "c": torch.zeros((), dtype=torch.int64)}
    save_file(tensors, tmp_path / "source")
    write_tensors(tmp_path / "copy", read_tensors(tmp_path / "source"))
    for stored in read_tensors(tmp_path / "copy").values():
        assert stored.start % DTYPES[stored.dtype].itemsize == 0
    with safe_open(tmp_path / "copy", framework="pt") as file:
        assert file.metadata() == {"format": "pt"}


@pytest.mark.parametrize("content", [b"", b"text", bytes(100), b"\xff" * 100])
def test_what_is_no_safetensors_file_is_refused(tmp_path: Path, content):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(ValueError, match="file is truncated or no safetensors file"):
        read_tensors(tmp_path / "file")
