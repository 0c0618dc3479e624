"""Intervals and tests against their definitions, by brute force."""

from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.study.statistics import bootstrap, compare, holm, wilson

tables = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@given(st.integers(1, 200), st.data())
def test_wilson_is_where_the_score_test_is_undecided(episodes, data):
    """Both ends solve |p_hat - p| = z sqrt(p (1 - p) / n)."""
    successes = data.draw(st.integers(0, episodes))
    z, rate = 1.959963984540054, successes / episodes
    for end in wilson(successes, episodes):
        assert abs(rate - end) == pytest.approx(z * np.sqrt(max(end * (1 - end), 0) / episodes), abs=1e-6)


@given(tables, st.integers(1, 4), st.integers(2, 30))
def test_mcnemar_counts_discordant_pairs_alone(random, seeds, episodes):
    first, second = random.random((2, seeds, episodes)) < 0.5
    result = compare(first, second)
    b, c = int((first & ~second).sum()), int((second & ~first).sum())
    n, smaller = b + c, min(b, c)
    exact = min(1.0, 2 * sum(comb(n, k) for k in range(smaller + 1)) / 2**n) if n else 1.0
    assert result.p == pytest.approx(exact)
    assert result.difference == pytest.approx(first.mean() - second.mean())
    assert result.low <= result.difference <= result.high
    turned = compare(second, first)
    assert (turned.difference, turned.p) == (pytest.approx(-result.difference), pytest.approx(result.p))


def test_the_interval_of_a_difference_knows_that_training_seeds_differ():
    """Same episodes in all: an effect in one seed of three is less certain than the same effect spread over all."""
    spread = np.zeros((3, 60), dtype=bool)
    spread[:, ::3] = True
    clustered = np.zeros((3, 60), dtype=bool)
    clustered[0] = True
    nothing = np.zeros((3, 60), dtype=bool)
    one, other = compare(spread, nothing), compare(clustered, nothing)
    assert one.difference == other.difference
    assert other.high - other.low > 3 * (one.high - one.low)
    assert other.low == 0.0  # a seed without the effect may be all there is


def test_seeds_of_different_tasks_are_resampled_apart():
    """Two tasks whose seeds differ alike say more together than each alone; the same one twice in step would not."""
    values = np.repeat(np.array([[0.0], [1.0]]), 40, axis=1)
    (mean, low, high), (_, alone_low, alone_high) = bootstrap(*[values] * 8), bootstrap(values)
    assert mean == 0.5
    assert high - low < 0.75 * (alone_high - alone_low)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_never_helps_and_keeps_the_order(p_values):
    adjusted = holm(p_values)
    assert all(a >= p for a, p in zip(adjusted, p_values, strict=True))
    assert min(adjusted) == pytest.approx(min(1.0, len(p_values) * min(p_values)))
    order = np.argsort(p_values, kind="stable")
    assert (np.diff(np.array(adjusted)[order]) >= 0).all()


def test_pairs_must_fit():
    with pytest.raises(ValueError, match="one shape"):
        compare(np.zeros((2, 3), dtype=bool), np.zeros((2, 4), dtype=bool))
