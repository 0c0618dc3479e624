"""Counts the bytes of storages that live while code runs, by purpose, and records the peak.

Run under PyTorch's `FakeTensorMode` it sees the very operations that a real run makes, of the very shapes and dtypes,
while nothing is allocated. `torch.distributed._tools.MemTracker` counts the same (a test compares the two), but it rounds as
CUDA does only for tensors on CUDA devices, and its categories do not know a cache or an encoder that no policy owns.
"""

import weakref
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, Literal

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

Purpose = Literal["weights", "gradients", "optimiser", "activations", "cache", "da3"]

CUDA_BLOCK = 512  # bytes: PyTorch's CUDA allocator hands out multiples of it (kMinBlockSize in CUDACachingAllocator)


@dataclass(frozen=True)
class MemorySplit:
    """Bytes at one moment, by purpose. "activations" are all without another purpose: inputs, intermediates, workspaces."""

    weights: int = 0
    gradients: int = 0
    optimiser: int = 0
    activations: int = 0
    cache: int = 0
    da3: int = 0

    @property
    def total(self) -> int:
        return sum(getattr(self, field.name) for field in fields(self))


class MemoryCounter(TorchDispatchMode):
    """While active, it counts every new storage as an activation, unless `naming` or `label` gives it another purpose.

    block: bytes that a storage is rounded up to; 1 for none.
    """

    def __init__(self, block: int = 1) -> None:
        super().__init__()
        self.block = block
        self.peak = MemorySplit()
        self._purpose: Purpose = "activations"
        self._now: Counter[Purpose] = Counter()
        self._total = 0
        self._highest = 0
        self._live: dict[int, tuple[weakref.ref, Purpose, int]] = {}

    @property
    def spare(self) -> int:
        """Bytes that were in use at the peak and are not now."""
        return self._highest - self._total

    @contextmanager
    def naming(self, purpose: Purpose) -> Iterator[None]:
        """New storages have this purpose inside the context."""
        before, self._purpose = self._purpose, purpose
        try:
            yield
        finally:
            self._purpose = before

    def label(self, tensors: Iterable[Tensor], purpose: Purpose) -> None:
        """Give the storages of these tensors a purpose, whether or not they have been counted before."""
        for tensor in tensors:
            key = self._track(tensor)
            reference, before, size = self._live[key]
            self._live[key] = (reference, purpose, size)
            self._now[before] -= size
            self._now[purpose] += size
        self._remember()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self._track(leaf)
        self._remember()
        return result

    def _track(self, tensor: Tensor) -> int:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key not in self._live:
            size = -(-storage.nbytes() // self.block) * self.block
            # PyTorch keeps a storage's Python object as long as the storage itself, so this is called when the storage is freed.
            self._live[key] = (weakref.ref(storage, lambda _: self._forget(key)), self._purpose, size)
            self._now[self._purpose] += size
            self._total += size
        return key

    def _forget(self, key: int) -> None:
        _, purpose, size = self._live.pop(key)
        self._now[purpose] -= size
        self._total -= size

    def _remember(self) -> None:
        if self._total > self._highest:
            self._highest = self._total
            self.peak = MemorySplit(**{purpose: size for purpose, size in self._now.items() if size})


def storage_bytes(tensors: Iterable[Tensor], block: int = 1) -> int:
    """Bytes of the distinct storages of these tensors, each rounded up to `block`."""
    storages = [tensor.untyped_storage() for tensor in tensors]
    distinct = {storage._cdata: storage.nbytes() for storage in storages}
    return sum(-(-size // block) * block for size in distinct.values())
