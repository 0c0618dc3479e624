"""What is proposed: fits, is the largest that does, comes best first, and keeps what the user has fixed."""

from dataclasses import replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.planner.counting import MemorySplit
from lerobot_policy_pi05_geometry.planner.gpus import needed
from lerobot_policy_pi05_geometry.planner.lora import LoraPlan
from lerobot_policy_pi05_geometry.planner.proposals import RECIPES, Fixed, Proposal, Rejection, _largest, propose
from lerobot_policy_pi05_geometry.planner.workload import FakePolicy, Load
from tests.doors import make_config

MIB = 2**20
NAMES = [recipe.name for recipe in RECIPES]
LOAD = Load(8, prompt_tokens=5)


@given(
    static=st.integers(0, 400), offset=st.integers(0, 200), slope=st.integers(1, 50), recomputed=st.integers(1, 20),
    wanted=st.integers(1, 70), budget=st.integers(790, 5000), fixed=st.sampled_from([None, True, False]),
)  # fmt: skip
def test_the_largest_batch_that_fits(static, offset, slope, recomputed, wanted, budget, fixed):
    """Against trying all; activations are a straight line, less steep with checkpointing."""
    assume(recomputed <= slope)

    def predict(rows: int, checkpointing: bool) -> tuple[Load, MemorySplit]:
        activations = (offset + rows * (recomputed if checkpointing else slope)) * MIB
        return replace(LOAD, batch_size=wanted, micro_batch_size=rows), MemorySplit(
            static * MIB, activations=activations
        )

    def fits(rows: int, checkpointing: bool) -> bool:
        return needed(predict(rows, checkpointing)[1]) <= budget * MIB

    tried = [wanted] + [2**k for k in range(8) if 2**k < wanted]
    with_it = fixed is not False
    expected = max((rows for rows in tried if fits(rows, with_it)), default=0)
    outcome = _largest(RECIPES[0], predict, wanted, budget * MIB, fixed)
    if not expected:
        assert isinstance(outcome, Rejection)
        return
    assert isinstance(outcome, Proposal)
    assert outcome.load.rows == expected
    assert needed(outcome.split) <= budget * MIB
    assert outcome.checkpointing == (fixed if fixed is not None else not (expected == wanted and fits(wanted, False)))


def outcomes(budget: int, fixed: Fixed | None = None, load: Load = LOAD) -> list[Proposal | Rejection]:
    return list(propose(lambda settings: make_config(**settings), load, budget, fixed or Fixed()))


def test_with_room_enough_everything_is_proposed_in_order_without_checkpointing():
    """But for 8 bits, which are not needed then."""
    found = outcomes(2**40)
    assert [proposal.recipe.name for proposal in found] == [name for name in NAMES if "8-bit" not in name]
    assert not any(proposal.checkpointing for proposal in found)
    assert all(proposal.load.rows == LOAD.batch_size for proposal in found)


def test_without_room_nothing_is():
    found = outcomes(2**20)
    assert [outcome.recipe.name for outcome in found] == NAMES
    assert all(isinstance(outcome, Rejection) and "GiB" in outcome.why for outcome in found)


def test_what_is_proposed_is_what_is_predicted():
    config = make_config(dtype="bfloat16", gradient_checkpointing=False)
    assert outcomes(2**40)[0].split == FakePolicy(config).training(LOAD)


def test_less_room_means_less_at_once():
    """With so many samples that activations outweigh the gradients, which every micro-batch but the first finds there."""
    fixed, load = Fixed({"gradient_checkpointing": True, "train_expert_only": True}), replace(LOAD, batch_size=64)
    whole = needed(outcomes(2**40, fixed, load)[0].split)
    first = outcomes(whole - 1, fixed, load)[0]
    assert first.recipe.name == "action expert only"
    assert first.load.rows < 64
    assert f"--policy.micro_batch_size={first.load.rows}" in first.options()
    assert "--batch_size=64" in first.options()


@pytest.mark.parametrize(
    ("fixed", "names"),
    [
        (Fixed({"train_expert_only": True}), ["action expert only"]),
        (Fixed({"freeze_vision_encoder": True}), ["all but the vision tower"]),
        (Fixed(lora=LoraPlan(3, "all")), ["LoRA on VLM and expert"]),
        (Fixed(optimizer="adamw8bit"), [name for name in NAMES if "8-bit" in name]),
        (Fixed({"param_dtype": "bfloat16"}), ["LoRA on VLM and expert", "LoRA on the expert"]),
        (Fixed({"train_expert_only": True, "freeze_vision_encoder": True}), []),
    ],
)
def test_what_is_fixed_stays(fixed, names):
    found = outcomes(2**40, fixed)
    assert [proposal.recipe.name for proposal in found] == names
    if fixed.lora is not None:
        assert found[0].recipe.lora == fixed.lora
