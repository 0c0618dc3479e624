"""The schedule is LeRobot's, and it says when the gate cannot open or has not."""

import logging

import pytest
import torch
from lerobot.optim.schedulers import (
    CosineDecayWithWarmupSchedulerConfig,
    load_scheduler_state,
    save_scheduler_state,
)

from lerobot_policy_pi05_geometry.training.parameter_groups import GATE_GROUP
from lerobot_policy_pi05_geometry.training.schedule import GateAwareScheduleConfig

SETTINGS = {"num_warmup_steps": 1_000, "num_decay_steps": 30_000, "peak_lr": 2.5e-5, "decay_lr": 2.5e-6}


def optimizer(openness: float, rate: float) -> torch.optim.Optimizer:
    gate = torch.nn.Parameter(torch.full((2, 3), openness))
    groups = [{"params": [torch.nn.Parameter(torch.zeros(2))]}, {"params": [gate], "lr": rate, "name": GATE_GROUP}]
    return torch.optim.AdamW(groups, lr=2.5e-5)


@pytest.mark.parametrize("steps", [2, 500, 40_000])
def test_rates_are_lerobots(steps) -> None:
    ours, theirs = optimizer(1.0, 1e-2), optimizer(1.0, 1e-2)
    schedule = GateAwareScheduleConfig(**SETTINGS).build(ours, steps)
    reference = CosineDecayWithWarmupSchedulerConfig(**SETTINGS).build(theirs, steps)
    for _ in range(min(steps, 1_200)):
        assert [group["lr"] for group in ours.param_groups] == [group["lr"] for group in theirs.param_groups]
        ours.step(), theirs.step()
        schedule.step(), reference.step()


@pytest.mark.parametrize(
    ("openness", "rate", "steps", "warns"),
    [
        (1e-7, 1e-2, 50, True),  # 50 steps have some 27 at the full rate
        (1e-7, 5e-2, 50, False),
        (1e-7, 1e-3, 1_000, True),
        (1e-7, 1e-3, 3_000, False),
        (-1e-7, 1e-3, 1_000, True),
        (1.0, 1e-3, 1, False),
    ],
)
def test_a_gate_that_cannot_open_is_named_before_the_run(openness, rate, steps, warns, caplog) -> None:
    """The bound is what Adam cannot pass: here it is driven with a gradient of one sign, and gets as far as that."""
    driven = optimizer(openness, rate)
    schedule = GateAwareScheduleConfig(**SETTINGS).build(driven, steps)
    assert ("cannot open in this run" in caplog.text) is warns
    gate = driven.param_groups[1]["params"][0]
    for _ in range(steps):
        gate.grad = -gate.detach().sign()
        driven.step()
        schedule.step()
    assert (gate.abs().mean().item() < 1.0) is warns


@pytest.mark.parametrize(("openness", "shut"), [(1e-7, True), (0.019, True), (-0.5, False), (1.0, False)])
def test_a_gate_that_stayed_shut_is_named_at_the_end_and_not_before(openness, shut, caplog) -> None:
    caplog.set_level(logging.INFO)
    frozen = optimizer(openness, 0.1)
    schedule = GateAwareScheduleConfig(**SETTINGS).build(frozen, 30)
    for step in range(30):
        assert "after 30 steps" not in caplog.text, step
        frozen.step()
        schedule.step()
    assert ("has stayed shut" in caplog.text) is shut
    assert caplog.text.count("after 30 steps") == 1


def test_an_optimiser_without_a_gate_says_nothing(caplog) -> None:
    plain = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(2))], lr=1e-5)
    schedule = GateAwareScheduleConfig(**SETTINGS).build(plain, 2)
    for _ in range(2):
        plain.step()
        schedule.step()
    assert "gate" not in caplog.text


def test_a_resumed_run_may_be_longer(tmp_path, caplog) -> None:
    """What is saved is what LeRobot saves of its own schedule."""
    short = GateAwareScheduleConfig(**SETTINGS).build(optimizer(1e-7, 0.1), 20)
    for _ in range(20):
        short.optimizer.step()
        short.step()
    assert caplog.text.count("has stayed shut") == 1
    save_scheduler_state(short, tmp_path)
    longer = GateAwareScheduleConfig(**SETTINGS).build(optimizer(1e-7, 0.1), 25)
    longer = load_scheduler_state(longer, tmp_path)
    assert longer.last_epoch == 20
    for _ in range(5):
        longer.optimizer.step()
        longer.step()
    assert caplog.text.count("has stayed shut") == 2
