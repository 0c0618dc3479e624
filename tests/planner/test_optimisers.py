"""State of optimisers: equal to the real one's where it is there, and by bitsandbytes' rules where it is not."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from lerobot_policy_pi05_geometry.planner.optimisers import EIGHT_BIT_MAPS, state_bytes, step_bytes

shapes = st.lists(st.tuples(st.integers(1, 90), st.integers(1, 90)), min_size=1, max_size=4)
dtypes = st.sampled_from([torch.float32, torch.bfloat16])


@given(shapes, dtypes)
def test_adamw_has_what_torch_keeps(sizes, dtype):
    parameters = [nn.Parameter(torch.zeros(size, dtype=dtype)) for size in sizes]
    optimizer = torch.optim.AdamW(parameters)
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    kept = sum(t.nbytes for state in optimizer.state.values() for name, t in state.items() if name != "step")
    assert step_bytes("adamw", parameters) == (kept, kept // 2)
    largest = max(parameter.nbytes for parameter in parameters)
    assert step_bytes("adamw", parameters, foreach=False) == (kept, 2 * largest)


@given(st.integers(1, 20_000))
def test_8_bits_from_4096_elements_on(count):
    parameter = torch.empty(count, device="meta")
    state = sum(state_bytes("adamw8bit", parameter))
    assert state == (8 * count if count < 4096 else 2 * count + 2 * 4 * ((count + 255) // 256))
    assert step_bytes("adamw8bit", [parameter]) == (state + EIGHT_BIT_MAPS, 0)


@given(shapes)
def test_blocks_are_rounded_up(sizes):
    parameters = [torch.empty(size, device="meta") for size in sizes]
    state, workspace = step_bytes("adamw", parameters, block=512)
    assert state % 512 == workspace % 512 == 0
    assert 0 <= state - step_bytes("adamw", parameters)[0] < 2 * 512 * len(parameters)


def test_an_unknown_optimiser():
    with pytest.raises(ValueError, match="adamw and adamw8bit, not 'lion'"):
        state_bytes("lion", torch.empty(2))
