"""What PyTorch's allocator holds while something runs, without the buffers that kernels of matrix products borrow.

Such a buffer is allocated and freed within one kernel: a matrix put into another order, the columns of a convolution, a tile in
another dtype. Which buffers there are, and how large, depends on the processor: oneDNN's kernels for AMX take more than those for
AVX2. All else is compared with the prediction: every tensor, however short it lives, on every processor alike.
"""

from collections.abc import Callable, Iterator
from typing import Any

from torch._C._profiler import _EventType, _ProfilerEvent
from torch.profiler import ProfilerActivity, profile

# Kernels that the planner sees as one operation, and that hand their work to oneDNN, MKL or PyTorch's own blocked loops.
BORROWING = {
    f"aten::{name}"
    for name in (
        "mm",
        "addmm",
        "bmm",
        "baddbmm",
        "convolution",
        "convolution_backward",
        "_scaled_dot_product_flash_attention_for_cpu",
        "_scaled_dot_product_flash_attention_for_cpu_backward",
    )
}


def allocated(run: Callable[[], Any]) -> int:
    """Bytes that are held at most while this runs, above those that were held before."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        run()
    tree = profiler.profiler.kineto_results.experimental_event_tree()
    events = sorted((e for root in tree for e in _own(root)), key=lambda e: e.start_time_ns)
    now = highest = 0
    for event in events:
        now += event.extra_fields.alloc_size
        highest = max(highest, now)
    return highest


def _own(event: _ProfilerEvent) -> Iterator[_ProfilerEvent]:
    """Allocations and releases below an event, but for those that a borrowing kernel both made and freed."""
    if event.tag == _EventType.Allocation:
        yield event
        return
    below = [e for child in event.children for e in _own(child)]
    yield from _without_pairs(below) if event.name in BORROWING else below


def _without_pairs(events: list[_ProfilerEvent]) -> list[_ProfilerEvent]:
    """The events whose storage was made or freed elsewhere."""
    made: dict[int, _ProfilerEvent] = {}
    borrowed: list[_ProfilerEvent] = []
    for event in sorted(events, key=lambda e: e.start_time_ns):
        address = event.extra_fields.ptr
        if event.extra_fields.alloc_size > 0:
            made[address] = event
        elif address in made:
            borrowed += [made.pop(address), event]
    return [event for event in events if not any(event is other for other in borrowed)]
