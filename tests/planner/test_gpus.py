"""Cards by name and by number."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.planner.counting import MemorySplit
from lerobot_policy_pi05_geometry.planner.gpus import GIB, GPUS, gpu_bytes, needed


@pytest.mark.parametrize(
    ("written", "name"),
    [("RTX 4090", "rtx4090"), ("NVIDIA GeForce RTX 3090", "rtx3090"), ("A100-80", "a100-80"), ("h100", "h100")],
)
def test_names_in_any_way_of_writing(written, name):
    assert gpu_bytes(written) == GPUS[name] * 2**20


@given(st.integers(1, 500))
def test_numbers(gigabytes):
    assert gpu_bytes(str(gigabytes)) == gpu_bytes(f"{gigabytes}GB") == gpu_bytes(f"{gigabytes} GiB") == gigabytes * GIB


@pytest.mark.parametrize("wrong", ["", "gtx970x", "0", "-3", "nan", "1e9"])
def test_other_names(wrong):
    with pytest.raises(ValueError, match="is not a GPU that the planner knows"):
        gpu_bytes(wrong)


@given(st.integers(0, 2**40), st.integers(1, 2**40))
def test_a_margin_is_left_and_grows(total, more):
    less, most = needed(MemorySplit(activations=total)), needed(MemorySplit(weights=total + more))
    assert total < less <= most
