"""What is counted: against PyTorch's own tracker, against the allocator, and bookkeeping."""

from itertools import pairwise

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch._subclasses import FakeTensorMode
from torch.distributed._tools.mem_tracker import MemTracker

from lerobot_policy_pi05_geometry.planner.acting import with_memory_kept
from lerobot_policy_pi05_geometry.planner.counting import MemoryCounter, MemorySplit, storage_bytes


def mlp(widths: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.GELU()]
    return nn.Sequential(*layers)


@given(st.lists(st.integers(1, 40), min_size=2, max_size=4), st.integers(1, 9))
def test_equals_pytorchs_memory_tracker(widths, batch):
    """Peak of all live bytes of a training pass."""

    def run(module: nn.Module) -> None:
        module(torch.zeros(batch, widths[0])).square().sum().backward()

    with FakeTensorMode():
        module = mlp(widths)
        tracker = MemTracker()
        tracker.track_external(module)
        with tracker:
            run(module)
        expected = tracker.get_tracker_snapshot("peak")[torch.device("cpu")]["Total"]
        module.zero_grad()
        counter = MemoryCounter()
        counter.label(module.parameters(), "weights")
        with counter:
            run(module)
    assert counter.peak.total == expected
    assert counter.peak.weights == storage_bytes(module.parameters())


@given(st.lists(st.integers(1, 5000), min_size=1, max_size=8), st.sampled_from([1, 512]))
def test_the_largest_moment_is_kept_and_freed_bytes_are_not(sizes, block):
    """Tensors that come one after the other, and the two largest neighbours at once."""

    def rounded(size: int) -> int:
        return -(-size // block) * block

    with FakeTensorMode(), MemoryCounter(block) as counter:
        tensor = None
        for size in sizes:
            tensor = torch.empty(size, dtype=torch.uint8)  # the one before lives until here
            view = tensor[: size // 2]
            del view
    pairs = [rounded(a) + rounded(b) for a, b in pairwise([0, *sizes])]
    assert counter.peak == MemorySplit(activations=max(pairs))


def test_labels_move_bytes_and_make_none():
    with FakeTensorMode(), MemoryCounter() as counter:
        a, b = torch.empty(10), torch.empty(20)
        counter.label([a], "cache")
        counter.label([a[2:], b], "gradients")  # a view of a is a
        counter.label([a], "cache")
        c = torch.empty(1)
    assert counter.peak == MemorySplit(cache=40, gradients=80, activations=4)
    assert storage_bytes([a, a[1:], b, c], 64) == 64 + 128 + 64


def test_what_comes_in_a_named_stretch_has_that_name():
    with FakeTensorMode(), MemoryCounter() as counter:
        a = torch.empty(10)
        with counter.naming("cache"):
            b = torch.empty(20)
        c = torch.empty(1)
    assert counter.peak == MemorySplit(cache=80, activations=44)
    assert storage_bytes([a, b, c]) == 124


def test_what_runs_beside_recorded_graphs_does_not_use_their_memory():
    counter = MemoryCounter()
    with FakeTensorMode(), counter:
        graphs = torch.empty(1000, dtype=torch.uint8)
        result = torch.empty(10, dtype=torch.uint8)
        del graphs
        beside = with_memory_kept(counter, lambda: torch.empty(400, dtype=torch.uint8))
        after = torch.empty(500, dtype=torch.uint8)  # in the graphs' memory again
    assert (counter.peak.total, counter.spare) == (1410, 1410 - 910)
    assert result.nbytes + beside.nbytes + after.nbytes == 910
