"""The measure that predictions are compared with: tensors count, buffers that a kernel borrows do not."""

import torch
from torch import Tensor

from tests.planner.allocations import BORROWING, allocated

ROWS = 64


def test_tensors_count_however_short_they_live() -> None:
    def run() -> Tensor:
        a = torch.empty(100, dtype=torch.uint8)
        torch.empty(1000, dtype=torch.uint8)  # freed at once
        return a

    assert allocated(run) == 1100


def test_the_result_of_a_borrowing_kernel_counts() -> None:
    a = torch.randn(ROWS, ROWS)
    assert allocated(lambda: a @ a) == a.nbytes


def test_buffers_of_a_borrowing_kernel_do_not_count() -> None:
    """A bf16 convolution lays out its inputs in columns, or its weights in another order, on every processor."""
    images, weights = torch.randn(2, 3, 28, 28).bfloat16(), torch.randn(32, 3, 14, 14).bfloat16()
    convolve = torch.nn.functional.conv2d
    result = 2 * 32 * 4 * 2
    assert allocated(lambda: convolve(images, weights, stride=14)) == result
    kernels = BORROWING.copy()
    try:
        BORROWING.clear()
        assert allocated(lambda: convolve(images, weights, stride=14)) > result
    finally:
        BORROWING.update(kernels)
