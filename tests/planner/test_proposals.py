"""What is proposed: fits, is the largest that does, comes best first, and keeps what the user has fixed."""

import importlib.util
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.planner.counting import MemorySplit
from lerobot_policy_pi05_geometry.planner.gpus import needed
from lerobot_policy_pi05_geometry.planner.proposals import RECIPES, Fixed, Proposal, Rejection, _largest, propose
from lerobot_policy_pi05_geometry.planner.workload import FakePolicy, Load
from tests.entry_points import make_config

MIB = 2**20
NAMES = [recipe.name for recipe in RECIPES]
LOAD = Load(8, prompt_tokens=5)


@given(
    static=st.integers(0, 400), offset=st.integers(0, 200), slope=st.integers(1, 50), share=st.floats(0, 1),
    wanted=st.integers(1, 70), budget=st.integers(790, 5000), fixed=st.sampled_from([None, True, False]),
)  # fmt: skip
def test_the_largest_batch_that_fits(static, offset, slope, share, wanted, budget, fixed):
    """Against trying all; activations are a straight line, less steep with checkpointing."""

    def predict(rows: int, checkpointing: bool) -> tuple[Load, MemorySplit]:
        activations = int((offset + rows * slope * (share if checkpointing else 1)) * MIB)
        return replace(LOAD, batch_size=wanted, micro_batch_size=rows), MemorySplit(
            static * MIB, activations=activations
        )

    def fits(rows: int, checkpointing: bool) -> bool:
        return needed(predict(rows, checkpointing)[1]) <= budget * MIB

    tried = [wanted] + [2**k for k in range(8) if 2**k < wanted]
    with_it = fixed is not False
    expected = max((rows for rows in tried if fits(rows, with_it)), default=0)
    settings = Fixed({} if fixed is None else {"gradient_checkpointing": fixed})
    outcome = _largest(RECIPES[0], predict, Load(wanted), budget * MIB, settings)
    if not expected:
        assert isinstance(outcome, Rejection)
        return
    assert isinstance(outcome, Proposal)
    assert outcome.load.rows == expected
    assert needed(outcome.split) <= budget * MIB
    assert outcome.checkpointing == (fixed if fixed is not None else not (expected == wanted and fits(wanted, False)))


@pytest.mark.parametrize("budget", [2**20, 2**40])
def test_a_given_micro_batch_is_not_searched(budget):
    def predict(rows: int, checkpointing: bool) -> tuple[Load, MemorySplit]:
        assert rows == 3
        return replace(LOAD, micro_batch_size=rows), MemorySplit(weights=2**30, activations=2**30)

    fixed = Fixed({"micro_batch_size": 3})
    outcome = _largest(RECIPES[0], predict, replace(LOAD, micro_batch_size=3), budget, fixed)
    assert isinstance(outcome, Proposal) == (budget == 2**40)
    assert isinstance(outcome, Rejection) or "--policy.micro_batch_size=3" in outcome.options()


def test_a_given_whole_batch_is_not_divided():
    """0 is a setting too."""
    sizes = []

    def predict(rows: int, checkpointing: bool) -> tuple[Load, MemorySplit]:
        sizes.append(rows)
        return replace(LOAD, micro_batch_size=rows), MemorySplit(weights=0, activations=rows * 2**30)

    outcome = _largest(RECIPES[0], predict, LOAD, 2**32, Fixed({"micro_batch_size": 0}))
    assert isinstance(outcome, Rejection)
    assert set(sizes) == {LOAD.batch_size}


def outcomes(budget: int, settings: dict | None = None, load: Load = LOAD, lora_rank: int | None = None):
    """Of the `tiny` policy without geometry; checkpointing is fixed unless a test is about it, for it doubles the runs."""
    fixed = Fixed({"geometry_source": "none", "gradient_checkpointing": True} | (settings or {}), lora_rank)
    return propose(lambda changes: make_config(**changes), load, budget, fixed)


def test_with_room_enough_everything_is_proposed_in_order():
    """But for 8 bits, which are not needed then."""
    pytest.importorskip("peft")
    found = list(outcomes(2**40))
    assert [proposal.recipe.name for proposal in found] == [name for name in NAMES if "8-bit" not in name]
    assert all(proposal.load.rows == LOAD.batch_size for proposal in found)


def test_without_room_nothing_is():
    pytest.importorskip("peft")
    found = list(outcomes(2**20))
    assert [outcome.recipe.name for outcome in found] == NAMES
    assert all(isinstance(outcome, Rejection) and "GiB" in outcome.why for outcome in found)


def test_what_is_proposed_is_what_is_predicted_and_checkpoints_only_if_it_must():
    fixed = Fixed({"geometry_source": "none"})
    plain = next(propose(lambda changes: make_config(**changes), LOAD, 2**40, fixed))
    config = make_config(dtype="bfloat16", geometry_source="none")
    assert plain.split == FakePolicy(config).training(LOAD)
    assert "--policy.gradient_checkpointing=true" not in plain.options()
    tight = next(propose(lambda changes: make_config(**changes), LOAD, needed(plain.split) - 1, fixed))
    assert tight.split.total < plain.split.total
    assert "--policy.gradient_checkpointing=true" in tight.options()


def test_less_room_means_less_at_once():
    """With so many samples that activations outweigh the gradients, which every micro-batch but the first finds there."""
    settings, load = {"train_expert_only": True}, replace(LOAD, batch_size=64)
    whole = needed(next(outcomes(2**40, settings, load)).split)
    first = next(outcomes(whole - 1, settings, load))
    assert first.recipe.name == "action expert only"
    assert first.load.rows < 64
    assert f"--policy.micro_batch_size={first.load.rows}" in first.options()
    assert "--batch_size=64" in first.options()


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"train_expert_only": True}, ["action expert only"]),
        ({"freeze_vision_encoder": True}, ["all but the vision tower"]),
        ({"optimizer": "adamw8bit"}, [name for name in NAMES if "8-bit" in name]),
        ({"param_dtype": "bfloat16", "lora_targets": "expert"}, ["LoRA on the expert"]),
        ({"train_expert_only": True, "freeze_vision_encoder": True}, []),
    ],
)
def test_what_is_fixed_stays(settings, names):
    pytest.importorskip("peft")
    found = list(outcomes(2**40, settings))
    assert [proposal.recipe.name for proposal in found] == names
    for proposal in found:
        assert {f"--policy.{name}={str(value).lower()}" for name, value in settings.items()} <= set(proposal.options())


def test_a_fixed_rank_leaves_lora_only():
    pytest.importorskip("peft")
    found = list(outcomes(2**40, lora_rank=3))
    assert [proposal.recipe.name for proposal in found] == [name for name in NAMES if "LoRA" in name]
    assert all("--peft.r=3" in proposal.options() for proposal in found)


def test_without_peft_lora_is_left_out_and_said(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    found = [outcome for outcome in outcomes(2**20) if isinstance(outcome, Rejection) and outcome.unavailable]
    assert [outcome.recipe.name for outcome in found] == [name for name in NAMES if "LoRA" in name]
    assert all("lerobot_policy_pi05_geometry[lora]" in outcome.why for outcome in found)
