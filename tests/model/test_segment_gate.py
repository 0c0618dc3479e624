"""The gate's parameter, its openness: every value of it has a finite gradient that is not zero, so it can always move."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.model.segment_gate import SMALLEST, GeometryGate, log_openness

from .helpers import SEGMENT, Case, build_network

AROUND_ZERO = [0.0, -0.0, 1e-9, -1e-9, 1e-8, -1e-8, 1e-7, -1e-7, 1e-30, -1e-30, 0.3, -0.3, 1.0, 20.0]


@pytest.mark.parametrize("openness", AROUND_ZERO)
def test_bias_and_gradient(openness: float) -> None:
    """log max(|x|, 1e-8), and the gradient of log |x| with the magnitude clamped likewise; at 0, that of the positive side."""
    x = torch.tensor(openness, requires_grad=True)
    bias = log_openness(x)
    bias.backward()
    size, sign = max(abs(openness), SMALLEST), -1.0 if openness < 0 else 1.0
    assert bias.item() == pytest.approx(math.log(size), abs=1e-5)
    assert x.grad.item() == pytest.approx(sign / size, rel=1e-5)


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bf16"])
@pytest.mark.parametrize("openness", AROUND_ZERO)
def test_every_gate_gets_a_finite_gradient_through_the_network(openness: float, autocast: bool) -> None:
    """Also under bf16 autocast, and where softmax gives geometry next to nothing."""
    network = build_network(SEGMENT, seed=3, dtype=torch.bfloat16 if autocast else torch.float32)
    gate = network.paligemma_with_expert.geometry_gate.openness
    with torch.no_grad():
        gate.fill_(openness)
    batch = Case(seed=4, batch=3).draw(network.geometry_width)
    network(*batch).mean().backward()
    assert gate.grad.isfinite().all()
    assert gate.grad.abs().min() > 0


@given(st.floats(1e-7, 1.0))
def test_the_gradient_does_not_shrink_with_the_openness(openness: float) -> None:
    """Of what attention gives: a log-gate at 1e-7 would have had a ten-millionth of the gradient that it has when open."""
    keys = torch.tensor([0.0, 0.0])
    x = torch.tensor(openness, requires_grad=True)
    (torch.cat([keys, log_openness(x)[None]]).softmax(dim=0)[2]).backward()
    assert 0.2 < x.grad.item() <= 0.5 + 1e-6


@pytest.mark.parametrize("start", [1e-7, -1e-7, 0.0])
def test_adam_opens_a_shut_gate_and_shuts_an_open_one(start: float) -> None:
    """Whatever side of zero it is on; a gate that is told to shut stays near zero, and can be opened again."""
    gate = GeometryGate(1, 1, start)
    optimizer = torch.optim.Adam(gate.parameters(), lr=0.05, eps=1e-12)

    def share() -> torch.Tensor:
        return gate(0, before=1, geometry=1, after=0).softmax(dim=-1)[0, 1]

    for direction, steps, expected in (
        (-1.0, 60, lambda s: s > 0.5),
        (1.0, 200, lambda s: s < 0.1),
        (-1.0, 200, lambda s: s > 0.5),
    ):
        for _ in range(steps):
            optimizer.zero_grad()
            (direction * share()).backward()
            optimizer.step()
        assert expected(share().item())
