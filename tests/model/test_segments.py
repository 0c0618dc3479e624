"""Invariant 6: masks and positions equal a table that is built entry by entry."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.policies.common.vla_utils import make_att_2d_masks
from torch import Tensor

from lerobot_policy_pi05_geometry.model import Segment
from lerobot_policy_pi05_geometry.model.segment_mask import make_att_mask, segment_mask
from lerobot_policy_pi05_geometry.model.segments import one_block, segment_positions

from .helpers import mask_table, position_table

X, O = True, False  # noqa: E741


def lists(elements: st.SearchStrategy, length: int) -> st.SearchStrategy:
    return st.lists(elements, min_size=length, max_size=length)


@st.composite
def layouts(draw: st.DrawFn) -> tuple[list[Tensor | None], list[list[int] | None]]:
    """Padding masks and att_masks of up to three segments; geometry may be absent or causal inside."""
    batch = draw(st.integers(1, 3))
    pads: list[Tensor | None] = []
    atts: list[list[int] | None] = []
    for segment in Segment:
        length = draw(st.integers(1, 6))
        if segment is Segment.GEOMETRY and draw(st.booleans()):
            pads.append(None)
            atts.append(None)
            continue
        pads.append(torch.tensor(draw(lists(lists(st.booleans(), length), batch))))
        later = draw(st.sampled_from([[0] * (length - 1), [1] * (length - 1), None]))
        later = draw(lists(st.integers(0, 1), length - 1)) if later is None else later
        opens = 0 if segment is Segment.PREFIX else 1
        atts.append([opens, *later])
    return pads, atts


@given(layouts())
def test_square_mask_equals_the_table(layout: tuple) -> None:
    """`make_att_mask` follows openpi's rule, and LeRobot's function wherever the query is no padding."""
    pads, atts = layout
    pad = torch.cat([p for p in pads if p is not None], dim=1)
    att = [entry for segment in atts if segment is not None for entry in segment]
    mask = make_att_mask(pad, att)
    assert torch.equal(mask, mask_table(pads, atts))
    theirs = make_att_2d_masks(pad, torch.tensor(att).expand_as(pad))
    assert torch.equal(mask & pad[:, :, None], theirs)


@given(layouts())
def test_rectangles_are_cuts_of_the_table(layout: tuple) -> None:
    """`segment_mask` is the segment's rows and the columns up to its end; right of that, nothing is visible."""
    pads, atts = layout
    table = mask_table(pads, atts)
    end = 0
    for segment in Segment:
        if pads[segment] is None:
            continue
        start, end = end, end + pads[segment].shape[1]
        rectangle = segment_mask(segment, pads, atts).expand(-1, end - start, -1)
        assert torch.equal(rectangle, table[:, start:end, :end])
        assert not table[:, start:end, end:].any()


@given(layouts(), st.sampled_from(["sequential", "parallel"]))
def test_positions_equal_the_table(layout: tuple, rule: str) -> None:
    """`segment_positions` counts real tokens, under both rules."""
    pads, _ = layout
    found = [None if p is None else p.tolist() for p in segment_positions(pads, rule)]
    assert found == position_table(pads, rule)


def test_the_drawing() -> None:
    """The table of the module's text, written by hand: two prefix tokens, three cells (one a hole), two actions."""
    pads = [torch.tensor([[X, X]]), torch.tensor([[X, O, X]]), torch.tensor([[X, X]])]
    atts = [[0, 0], one_block(3), one_block(2)]
    drawing = torch.tensor(
        [
            [X, X, O, O, O, O, O],
            [X, X, O, O, O, O, O],
            [X, X, X, O, X, O, O],
            [X, X, X, O, X, O, O],
            [X, X, X, O, X, O, O],
            [X, X, X, O, X, X, X],
            [X, X, X, O, X, X, X],
        ]
    )
    assert torch.equal(mask_table(pads, atts)[0], drawing)
    assert torch.equal(make_att_mask(torch.cat(pads, dim=1), [*atts[0], *atts[1], *atts[2]])[0], drawing)
    assert [p.tolist() for p in segment_positions(pads, "sequential")] == [[[0, 1]], [[2, 2, 3]], [[4, 5]]]
    assert [p.tolist() for p in segment_positions(pads, "parallel")] == [[[0, 1]], [[2, 3, 4]], [[2, 3]]]


def test_one_block_is_one_row() -> None:
    """A segment that is one block needs one mask row for all its queries, not one for each."""
    pads = [torch.ones(2, 4, dtype=torch.bool), torch.ones(2, 3, dtype=torch.bool), None]
    assert segment_mask(Segment.GEOMETRY, pads, [[0] * 4, one_block(3), None]).shape == (2, 1, 7)
    assert segment_mask(Segment.GEOMETRY, pads, [[0] * 4, [1, 1, 0], None]).shape == (2, 3, 7)


@pytest.mark.parametrize("segment", [Segment.GEOMETRY, Segment.SUFFIX])
def test_a_segment_that_joins_the_one_before_is_refused(segment: Segment) -> None:
    """With a first entry of 0 the VLM would see geometry, or geometry the actions."""
    pads = [torch.ones(1, 3, dtype=torch.bool)] * 3
    atts = [[0, 0, 0], [1, 0, 0], [1, 0, 0]]
    segment_mask(segment, pads, atts)
    atts[segment] = [0, 0, 0]
    with pytest.raises(ValueError, match=f"first token of the {segment.name.lower()} segment must have att_mask 1"):
        segment_mask(segment, pads, atts)


def test_wrong_number_of_entries_is_refused() -> None:
    """One att_mask entry per token."""
    pads = [torch.ones(1, 3, dtype=torch.bool), torch.ones(1, 2, dtype=torch.bool), None]
    with pytest.raises(ValueError, match="5 tokens, 6 entries"):
        segment_mask(Segment.GEOMETRY, pads, [[0, 0, 0], [1, 0, 0], None])


@given(layouts())
def test_parallel_geometry_moves_nothing(layout: tuple) -> None:
    """Under "parallel" the suffix stands as if there were no geometry, and a cell as if there were no holes."""
    (prefix, geometry, suffix), _ = layout
    alone = segment_positions([prefix, None, suffix], "sequential")
    if geometry is None:
        geometry = torch.zeros(prefix.shape[0], 2, dtype=torch.bool)
    beside = segment_positions([prefix, geometry, suffix], "parallel")
    full = segment_positions([prefix, torch.ones_like(geometry), suffix], "parallel")
    assert torch.equal(beside[Segment.SUFFIX], alone[Segment.SUFFIX])
    assert torch.equal(beside[Segment.GEOMETRY], full[Segment.GEOMETRY])
