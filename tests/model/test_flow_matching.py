"""Noise, flow time and dropout are functions of (seed, step, dataset index) and of nothing else."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.model.flow_matching import FlowDraw, draw_flow

SHAPE = (4, 3)
BETA = {"alpha": 1.5, "beta": 1.0, "scale": 0.999, "offset": 0.001}

seeds = st.integers(0, 2**64 - 2)
steps = st.integers(-1, 2**40)
indices = st.integers(-1, 2**40)


def draw(seed: int, step: int, indices: list[int]) -> FlowDraw:
    return draw_flow(seed, step, indices, SHAPE, **BETA, max_delay=5)


def same(a: FlowDraw, b: FlowDraw) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def nothing_shared(a: FlowDraw, b: FlowDraw) -> bool:
    """No number of one draw occurs anywhere in the other, so neither is a shifted copy."""
    return not any(torch.isin(x, y).any() for x, y in zip(a, b, strict=True) if x is not a.delay)


@given(seeds, steps, indices)
def test_same_key_same_draw(seed: int, step: int, index: int) -> None:
    """A resumed run draws again what it drew, whatever the global generators did meanwhile."""
    first = draw(seed, step, [index])
    torch.manual_seed(step % 1000)
    torch.rand(7)
    assert same(draw(seed, step, [index]), first)


@given(seed=seeds, step=steps, index=indices)
@example(seed=3, step=-1, index=2)  # -1 is the step of evaluation
@example(seed=2**63, step=4, index=5)  # torch's seeds have 64 bits
def test_another_key_another_draw(seed: int, step: int, index: int) -> None:
    """Neighbouring seeds, steps and indices share no number, and neither does a key with its entries exchanged."""
    first = draw(seed, step, [index])
    assert nothing_shared(draw(seed + 1, step, [index]), first)
    assert nothing_shared(draw(seed, step + 1, [index]), first)
    assert nothing_shared(draw(seed, step, [index + 1]), first)
    if len({seed, step, index}) == 3:
        assert nothing_shared(draw(step, seed, [index]), first)
        assert nothing_shared(draw(index, step, [seed]), first)


@given(st.lists(indices, min_size=1, max_size=6, unique=True), st.randoms(use_true_random=False))
def test_the_batch_does_not_matter(members: list[int], random) -> None:
    """A sample's draw is the same alone, in any batch, at any place: so with another number of processes."""
    together = draw(1, 2, members)
    shuffled = random.sample(members, len(members))
    reordered = draw(1, 2, shuffled)
    for place, index in enumerate(members):
        alone = draw(1, 2, [index])
        elsewhere = shuffled.index(index)
        for whole, moved, single in zip(together, reordered, alone, strict=True):
            assert torch.equal(whole[place], single[0])
            assert torch.equal(moved[elsewhere], single[0])


def test_shapes_and_types() -> None:
    """(B, S, D), and (B,) for the rest, all float32 but delay and key."""
    drawn = draw(0, 0, [5, 6])
    assert [tuple(x.shape) for x in drawn] == [(2, 4, 3), (2,), (2,), (2,), (2,), (2,)]
    assert {x.dtype for x in drawn[:-2]} == {torch.float32}
    assert drawn.delay.dtype == drawn.key.dtype == torch.int64


@pytest.mark.parametrize("vary", ["step", "index"])
def test_distributions(vary: str) -> None:
    """Noise is standard normal, time is Beta(1.5, 1) in [0.001, 1], the rest uniform: over steps and over samples."""
    count = 4000
    if vary == "index":
        noise, time, *uniform, _, key = draw(3, 7, list(range(count)))
    else:
        noise, time, *uniform, _, key = (
            torch.cat(parts) for parts in zip(*(draw(3, step, [7]) for step in range(count)), strict=True)
        )
    assert abs(noise.mean()) < 0.02
    assert abs(noise.std() - 1) < 0.02
    assert time.min() >= 0.001
    assert time.max() <= 1.0
    # P(time <= t) = u^1.5 with u = (t - offset) / scale, for Beta(1.5, 1).
    for t in (0.1, 0.3, 0.5, 0.8):
        assert abs((time <= t).float().mean() - ((t - 0.001) / 0.999) ** 1.5) < 0.03
    for drawn in (*uniform, key.double() / 2**62):
        assert 0 <= drawn.min() < 0.01
        assert 0.99 < drawn.max() < 1
        for p in (0.1, 0.5, 0.9):
            assert abs((drawn < p).float().mean() - p) < 0.03


def test_the_draws_are_independent() -> None:
    """No two of the draws of a sample are correlated, and neither are those of two steps."""
    noise, *rest, delay, key = draw(4, 0, list(range(4000)))
    later = draw(4, 1, list(range(4000))).noise
    columns = torch.stack([noise[:, 0, 0], noise[:, 1, 0], later[:, 0, 0], *rest, delay.float(), key / 2**62])
    correlation = torch.corrcoef(columns) - torch.eye(len(columns))
    assert correlation.abs().max() < 0.06


def test_several_flow_samples() -> None:
    """K noises and times per observation, no two alike, and one of the other draws; keyed like a single one."""
    drawn = draw_flow(0, 0, [5, 6], SHAPE, **BETA, samples=3)
    assert [tuple(x.shape) for x in drawn] == [(2, 3, 4, 3), (2, 3), (2,), (2,), (2,), (2,)]
    noise, time, *_ = drawn
    assert len(noise.unique()) == noise.numel()
    assert len(time.unique()) == time.numel()
    alone = draw_flow(0, 0, [6], SHAPE, **BETA, samples=3)
    assert same(alone, FlowDraw(*(x[1:] for x in drawn)))


def test_delays_are_uniform_and_change_no_other_draw() -> None:
    """From 0 to the longest, both included; without delays all else is as it was."""
    drawn = draw(0, 0, list(range(3000)))
    counts = torch.bincount(drawn.delay)
    assert len(counts) == 6
    assert ((counts - 500).abs() < 100).all()
    without = draw_flow(0, 0, list(range(3000)), SHAPE, **BETA)
    assert not without.delay.any()
    assert same(drawn._replace(delay=without.delay), without)


def test_alpha_and_beta_are_used() -> None:
    """Mean of Beta(a, b) is a / (a + b)."""
    for alpha, beta in ((1.0, 3.0), (4.0, 1.0)):
        time = draw_flow(0, 0, list(range(2000)), (1, 1), alpha=alpha, beta=beta, scale=1.0, offset=0.0).time
        assert time.mean().item() == pytest.approx(alpha / (alpha + beta), abs=0.02)
