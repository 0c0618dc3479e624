"""CUDA graphs imitated on a CPU: every operation is recorded with its tensors, and repeated with the same tensors.

A decision that Python took while recording stays taken, and a tensor that the work reads but does not write keeps its value. So
code that would be wrong in a graph is wrong here too. An operation that would make the host wait for a GPU is an error.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lerobot_policy_pi05_geometry.inference.backend import Backend
from lerobot_policy_pi05_geometry.inference.recorder import Recorder

WAITS = {"_local_scalar_dense", "item", "is_nonzero", "equal", "nonzero", "masked_select", "_unique2", "unique_dim"}


def storages(tree: Any) -> set[int]:
    """Of all tensors."""
    return {leaf.untyped_storage()._cdata for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)}


class Tape(TorchDispatchMode):
    """Records the operations while it is active."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[tuple[Callable, tuple, dict, list[Tensor]]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name, kwargs = func.__name__.split(".")[0], kwargs or {}
        picks = name in ("index", "index_put", "index_put_")
        if name in WAITS or (picks and any(getattr(i, "dtype", None) == torch.bool for i in args[1])):
            raise RuntimeError(f"A GPU would be waited for: {name}")
        out = func(*args, **kwargs)
        new = [t for t in tree_leaves(out) if isinstance(t, Tensor) and not storages(t) & storages((args, kwargs))]
        self.steps.append((func, args, kwargs, new))
        return out

    def play(self) -> None:
        for func, args, kwargs, new in self.steps:
            again = [t for t in tree_leaves(func(*args, **kwargs)) if isinstance(t, Tensor)]
            for old, now in zip(new, again, strict=False):
                old.copy_(now)


class TapeRecorder:
    """A `Recorder` by tapes. tapes: all that it has made."""

    def __init__(self, device: torch.device) -> None:
        self.tapes: list[Tape] = []

    def record[T](self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        with Tape() as tape:
            result = work()
        for *_, new in tape.steps:  # a graph leaves no values behind when it is recorded
            for tensor in new:
                tensor.fill_(True if tensor.dtype == torch.bool else 113)
        self.tapes.append(tape)
        return result, tape.play


class TapeBackend(Backend):
    """A CPU that can record."""

    can_record = True

    def new_recorder(self) -> Recorder:
        return TapeRecorder(self.device)
