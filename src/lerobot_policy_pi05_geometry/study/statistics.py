"""Intervals and tests for success rates and their differences.

Episodes are paired: with the same training seed and evaluation seed, both arms observe the same scene. So arms are compared
by their discordant pairs (exact McNemar test; McNemar, 1947), corrected for the number of comparisons (Holm, 1979). The
interval of a difference is from a bootstrap over training seeds and, within them, episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

CONFIDENCE = 0.95
_RESAMPLES = 2_000


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """95 % Wilson interval of a success rate."""
    interval = binomtest(successes, episodes).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class Difference:
    """Success of one arm minus another's: the difference of the rates, its 95 % bootstrap interval, McNemar's p."""

    difference: float
    low: float
    high: float
    p: float


def compare(first: np.ndarray, second: np.ndarray) -> Difference:
    """Compare two arms on the same seeds; both (training seeds, episodes) bool."""
    if first.shape != second.shape or first.ndim != 2:
        raise ValueError(f"Paired episodes need two tables of one shape, got {first.shape} and {second.shape}.")
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    discordant = only_first + only_second
    p = float(binomtest(only_first, discordant, 0.5).pvalue) if discordant else 1.0
    return Difference(*bootstrap(first.astype(float) - second.astype(float)), p)


def bootstrap(*tables: np.ndarray) -> tuple[float, float, float]:
    """Mean of (training seeds, episodes) values, with its 95 % interval: seeds are resampled, then episodes within them.

    For several tables, one per task: the mean of their means. The resampling has a fixed seed, so a report is reproducible.
    """
    random = np.random.default_rng(0)
    means = []
    for values in tables:
        seeds, episodes = values.shape
        rows = random.integers(seeds, size=(_RESAMPLES, seeds, 1))
        columns = random.integers(episodes, size=(_RESAMPLES, seeds, episodes))
        means.append(values[rows, columns].mean(axis=(1, 2)))
    low, high = np.quantile(np.mean(means, axis=0), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(np.mean([values.mean() for values in tables])), float(low), float(high)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: p-values adjusted for the number of tests."""
    order = np.argsort(p_values)
    adjusted = np.empty(len(p_values))
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted.tolist()
