"""8-bit AdamW: close to the 32-bit one, smaller, and saved and resumed bit for bit through LeRobot's own functions."""

import importlib.util

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.optim import OptimizerConfig
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from torch import Tensor, nn

from lerobot_policy_pi05_geometry.training.optim import AdamW8bitConfig
from lerobot_policy_pi05_geometry.training.parameter_groups import FULL_STATE
from tests.entry_points import make_batch, make_policy

pytest.importorskip("torchao")
SETTINGS = {"lr": 3e-3, "betas": (0.9, 0.95), "eps": 1e-8, "weight_decay": 0.1}
BLOCK, SMALLEST = 256, 4096


def parameters(shapes: list[tuple[int, ...]], seed: int = 0) -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(seed)
    return [nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]


def take_steps(optimizer, params: list[nn.Parameter], steps: range) -> None:
    """Gradients are a function of the step, with a signal that stays and noise that does not."""
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        for p in params:
            p.grad = (0.1 + torch.randn(p.shape, generator=generator)).to(p.dtype)
        optimizer.step()
        optimizer.zero_grad()


def moments(optimizer) -> dict[str, Tensor]:
    return {
        f"{index}/{name}": tensor
        for index, state in optimizer.state_dict()["state"].items()
        for name, tensor in state.items()
    }


@settings(max_examples=6, deadline=None)
@given(rows=st.integers(1, 40), columns=st.sampled_from([3, 64, 256]), decay=st.sampled_from([0.0, 0.1]))
def test_it_moves_as_adamw_does(rows, columns, decay):
    """Tensors that stay in 32 bits to rounding; the others as far, and in nearly the same direction."""
    changes = {**SETTINGS, "weight_decay": decay}
    start = parameters([(rows, columns)])[0].detach().clone()
    ours, theirs = parameters([(rows, columns)]), parameters([(rows, columns)])
    take_steps(AdamW8bitConfig(**changes).build(ours), ours, range(10))
    take_steps(torch.optim.AdamW(theirs, **changes), theirs, range(10))
    moved, expected = ours[0].detach() - start, theirs[0].detach() - start
    quantised = moved.numel() >= SMALLEST and moved.numel() % BLOCK == 0
    if quantised:
        assert (moved - expected).norm() < 0.1 * expected.norm()
        assert not torch.allclose(moved, expected, atol=1e-6)
    else:
        torch.testing.assert_close(moved, expected, atol=1e-6, rtol=1e-5)


def test_moments_take_two_bytes_and_a_scale_per_block():
    params = parameters([(64, 128), (10,), (3, 1366)])  # large, small, and no multiple of a block
    optimizer = AdamW8bitConfig(**SETTINGS).build(params)
    take_steps(optimizer, params, range(1))
    found = {name: tensor for name, tensor in moments(optimizer).items() if not name.endswith("step")}
    assert {name: tensor.dtype for name, tensor in found.items() if name.startswith("0/")} == {
        "0/exp_avg_codes": torch.uint8,
        "0/exp_avg_scale": torch.float32,
        "0/exp_avg_sq_codes": torch.uint8,
        "0/exp_avg_sq_scale": torch.float32,
    }
    assert sum(t.nbytes for name, t in found.items() if name.startswith("0/")) == 2 * (64 * 128) * (1 + 4 / BLOCK)
    assert {tensor.dtype for name, tensor in found.items() if not name.startswith("0/")} == {torch.float32}


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_resumed_run_equals_one_that_was_not_bit_for_bit(tmp_path, dtype):
    """Groups with rates of their own, one of them in 32 bits, a learning rate that a scheduler moves."""

    def build():
        large, small, new = parameters([(64, 128), (7,), (80, 64)])
        params = [nn.Parameter(large.detach().to(dtype)), nn.Parameter(small.detach().to(dtype)), new]
        group = {"params": params[2:], "lr": 1e-2, "eps": 1e-12, "weight_decay": 0.0, FULL_STATE: True}
        optimizer = AdamW8bitConfig(**SETTINGS).build([{"params": params[:2]}, group])
        return params, optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 / (1 + step))

    params, optimizer, scheduler = build()
    for step in range(3):
        take_steps(optimizer, params, range(step, step + 1))
        scheduler.step()
    save_optimizer_state(optimizer, tmp_path)
    weights = [p.detach().clone() for p in params]
    scheduler_state = scheduler.state_dict()
    for step in range(3, 6):
        take_steps(optimizer, params, range(step, step + 1))
        scheduler.step()

    again, resumed, scheduler = build()
    with torch.no_grad():
        for p, weight in zip(again, weights, strict=True):
            p.copy_(weight)
    load_optimizer_state(resumed, tmp_path)
    scheduler.load_state_dict(scheduler_state)
    resumed.load_state_dict(resumed.state_dict())  # accelerate does this once more
    for step in range(3, 6):
        take_steps(resumed, again, range(step, step + 1))
        scheduler.step()
    assert all(torch.equal(p, q) for p, q in zip(params, again, strict=True))
    expected, found = moments(optimizer), moments(resumed)
    assert found.keys() == expected.keys()
    assert all(
        torch.equal(found[name], tensor) and found[name].dtype == tensor.dtype for name, tensor in expected.items()
    )
    assert found["2/exp_avg"].dtype == torch.float32
    assert resumed.param_groups[0]["lr"] == optimizer.param_groups[0]["lr"] == pytest.approx(3e-3 / 7)
    assert isinstance(resumed.param_groups[0]["lr"], float)


def test_the_preset_builds_it_with_the_policys_groups():
    """New parameters keep 32 bits: gradients behind a closed gate are too small for 8."""
    policy = make_policy(optimizer="adamw8bit", geometry_lr=3e-4, geometry_gate_lr=7e-3).train()
    preset = policy.config.get_optimizer_preset()
    assert OptimizerConfig.get_choice_class("adamw8bit") is type(preset)
    optimizer = preset.build(policy.get_optim_params())
    assert [group["lr"] for group in optimizer.param_groups] == [2.5e-5, 3e-4, 7e-3]
    assert [group["eps"] for group in optimizer.param_groups] == [1e-8, 1e-12, 1e-12]
    assert [group["weight_decay"] for group in optimizer.param_groups] == [0.01, 0.0, 0.0]
    policy.forward(make_batch())[0].backward()
    optimizer.step()
    new = {id(p) for p in policy.new_parameters().values()}
    eight_bits = {p for p, state in optimizer.state.items() if type(state["exp_avg"]) is not Tensor}
    assert eight_bits == {
        p for p in optimizer.state if id(p) not in new and p.numel() >= SMALLEST and p.numel() % BLOCK == 0
    }
    assert eight_bits
    assert [group.get(FULL_STATE, False) for group in optimizer.param_groups] == [False, True, True]


def test_gradients_behind_a_closed_gate_move_the_new_parameters_as_much_as_adamw():
    """Their squares are below the smallest scale that 8 bits have."""
    moved = []
    for kind in (AdamW8bitConfig, None):
        params = parameters([(64, 64)])
        start = params[0].detach().clone()
        group = {"params": params, "eps": 1e-16, FULL_STATE: True}
        optimizer = kind(**SETTINGS).build([group]) if kind else torch.optim.AdamW([group], **SETTINGS)
        for step in range(20):
            params[0].grad = 1e-9 * torch.randn(64, 64, generator=torch.Generator().manual_seed(step))
            optimizer.step()
        moved.append(params[0].detach() - start)
    torch.testing.assert_close(moved[0], moved[1], atol=1e-6, rtol=1e-4)


@pytest.mark.slow
def test_the_loss_falls_as_with_adamw():
    """Forty steps on one batch: within a few percent of 32 bits."""
    last = {}
    for optimizer_name in ("adamw", "adamw8bit"):
        policy = make_policy(
            optimizer=optimizer_name, optimizer_lr=1e-3, geometry_dropout=0.0, image_dropout=0.0
        ).train()
        optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
        losses = []
        for _ in range(40):
            loss, _ = policy.forward(make_batch(8))
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
            losses.append(loss.item())
        assert losses[-1] < 0.5 * losses[0]
        last[optimizer_name] = sum(losses[-5:])
    assert last["adamw8bit"] == pytest.approx(last["adamw"], rel=0.05)


def test_without_torchao_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"\[adamw8bit\]"):
        AdamW8bitConfig().build([])
