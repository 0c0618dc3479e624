"""Robots, a server and faults; see soak.py."""

import pytest

from .soak import FAULTS, soak


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [7, pytest.param(1800, marks=pytest.mark.long)])
def test_no_chunk_is_lost_or_foreign_whatever_goes_wrong(seconds):
    short = seconds < 60
    seen = soak(
        seconds,
        robots=4 if short else 8,
        fault=1 if short else 30,
        rate=20 if short else 3,
        side=40 if short else 640,
    )
    assert seen["wrong_chunks"] == 0, seen
    assert seen["tracebacks"] == 0, seen
    assert all(seen["faults"][kind] for kind in FAULTS), seen
    assert min(seen["chunks_per_robot"]) > 0.2 * max(seen["chunks_per_robot"]), seen
    assert seen["lost_connections"] > 0, seen  # of the restarts
    for first, last in seen["memory_mib"]:
        assert last - first < 50, seen
