"""State of optimisers: equal to the real ones'."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from lerobot_policy_pi05_geometry.planner.optimisers import state_bytes, step_bytes
from lerobot_policy_pi05_geometry.training.parameter_groups import FULL_STATE

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
    assert step_bytes("adamw", [{"params": parameters}]) == (kept, kept // 2)
    largest = max(parameter.nbytes for parameter in parameters)
    assert step_bytes("adamw", [{"params": parameters}], foreach=False) == (kept, 2 * largest)


@given(st.sampled_from([(4095,), (64, 64), (4097,), (64, 66), (3, 1792), (16, 16)]), st.booleans())
def test_8_bits_are_what_torchao_keeps(shape, full):
    """In 8 bits from 4,096 numbers on, in whole blocks of 256, unless a group wants full state."""
    pytest.importorskip("torchao")
    from lerobot_policy_pi05_geometry.training.adamw8bit import AdamW8bit

    parameter = nn.Parameter(torch.zeros(shape))
    group = {"params": [parameter], FULL_STATE: full}
    optimizer = AdamW8bit([dict(group)], lr=1e-3)
    parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    kept = 0
    for name, moment in optimizer.state[parameter].items():
        if name != "step":
            parts = [moment.codes, moment.scale, moment.qmap] if hasattr(moment, "codes") else [moment]
            kept += sum(part.nbytes for part in parts)
    assert step_bytes("adamw8bit", [group])[0] == kept


@given(shapes)
def test_blocks_are_rounded_up(sizes):
    groups = [{"params": [torch.empty(size, device="meta") for size in sizes]}]
    state, workspace = step_bytes("adamw", groups, block=512)
    assert state % 512 == workspace % 512 == 0
    assert 0 <= state - step_bytes("adamw", groups)[0] < 2 * 512 * len(sizes)


def test_groups_are_updated_one_after_the_other():
    groups = [{"params": [torch.empty(count, device="meta")]} for count in (10, 30)]
    assert step_bytes("adamw", groups) == (2 * 4 * 40, 4 * 30)


def test_an_unknown_optimiser():
    with pytest.raises(ValueError, match="adamw and adamw8bit, not 'lion'"):
        state_bytes("lion", torch.empty(2))
