"""The most memory that live tensors take while something runs: in the allocator's books on a GPU, by watching on a CPU."""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter


class _LiveTensors(TorchDispatchMode):
    """Counts bytes of storages from their first use in here until they are freed."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = self.peak = 0
        self.known: set[int] = set()

    def add(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key not in self.known:
            self.known.add(key)
            self.bytes += size
            self.peak = max(self.peak, self.bytes)
            weakref.finalize(storage, self.remove, key, size)

    def remove(self, key: int, size: int) -> None:
        self.known.discard(key)
        self.bytes -= size

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for value in tree_iter(result):
            if isinstance(value, Tensor):
                self.add(value)
        return result


def peak_memory(module: nn.Module, step: Callable[[], object], held: Sequence[Tensor] = ()) -> float:
    """MiB of live tensors at the peak of a step that starts without gradients; `held` is there beside the module's.

    What else is on the device, the network that this one is compared with for example, is left out.
    """
    module.zero_grad()
    own = [*module.parameters(), *module.buffers(), *held]
    if own[0].is_cuda:
        storages = {tensor.untyped_storage()._cdata: tensor.untyped_storage() for tensor in own}
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        step()
        torch.cuda.synchronize()
        peak = torch.cuda.max_memory_allocated() - before
        return (peak + sum(storage.nbytes() for storage in storages.values())) / 2**20
    with _LiveTensors() as live:
        for tensor in own:
            live.add(tensor)
        step()
    return live.peak / 2**20
