"""Recording of GPU work, so that it can be repeated without launching its kernels one by one."""

from collections.abc import Callable
from typing import Protocol

import torch

_WARM_UP = 3  # runs before recording: libraries choose kernels and allocate workspaces


class Recorder(Protocol):
    """Makes work that computes tensors from tensors repeatable."""

    def record[T](self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """The result of `work`, without values yet, and a function that computes them from the tensors that `work` read."""
        ...


class CudaGraphRecorder:
    """Records CUDA graphs that share their memory."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()

    def record[T](self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        main = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(main)
        with torch.cuda.stream(self._stream):
            for _ in range(_WARM_UP):
                work()
        main.wait_stream(self._stream)  # the warm-up writes to a cache that the first replay writes to as well
        graph = torch.cuda.CUDAGraph()
        # GPU work of other threads, such as a camera's, is neither recorded nor an error.
        with torch.cuda.graph(graph, pool=self._pool, stream=self._stream, capture_error_mode="thread_local"):
            result = work()
        return result, graph.replay
