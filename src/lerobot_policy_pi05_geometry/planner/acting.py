"""Sampling of action chunks on fake tensors: the real sampler, on a backend that tells a counter what is allocated for what."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from ..inference.backend import Backend
from ..inference.sampler import ChunkSampler
from ..inference.side_stream import PendingGeometry
from ..model.config import RunnerName
from ..model.paligemma_with_expert import PaliGemmaWithExpert
from ..model.pi05 import PI05Pytorch
from ..model.segment_cache import SegmentKVCache
from .counting import MemoryCounter

Target = Literal["cuda", "cpu"]


class CountedBackend(Backend):
    """The choices of a target, for tensors on the CPU. The cache is counted as a cache. Nothing is recorded."""

    can_record = False

    def __init__(self, device: torch.device, counter: MemoryCounter, target: Target) -> None:
        super().__init__(device)
        self.kernels = target
        self._counter = counter

    def new_cache(self, network: PaliGemmaWithExpert, batch: int, lengths: Sequence[int]) -> SegmentKVCache:
        cache = super().new_cache(network, batch, lengths)
        self._counter.label([cache.keys, cache.values], "cache")
        return cache


def with_memory_kept[T](counter: MemoryCounter, work: Callable[[], T]) -> T:
    """Run work that cannot use the memory that was freed before: recorded graphs keep theirs although nothing runs in it."""
    kept = torch.empty(counter.spare, dtype=torch.uint8)
    result = work()
    del kept
    return result


class CountedSampler(ChunkSampler):
    """The sampler of a planned policy. What the runner builds counts as weights, the cache as a cache.

    target: whose kernels and graphs are assumed.
    """

    def __init__(self, network: PI05Pytorch, counter: MemoryCounter, target: Target) -> None:
        super().__init__(network, partial(CountedBackend, counter=counter, target=target))
        self._counter, self._target = counter, target

    def forward(self, *observation: Any, runner: RunnerName = "fast", **kwargs: Any) -> Tensor:
        if runner == "plain":
            hook = self._network.paligemma_with_expert.register_forward_pre_hook(self._label_cache, with_kwargs=True)
            actions = super().forward(*observation, runner="plain", **kwargs)
            hook.remove()
            return actions
        with self._counter.naming("weights"):
            self.prepare("eager")
        kept: list[Tensor] = []
        geometry = kwargs.get("geometry")
        if geometry is not None and self._target == "cuda" and runner == "fast":
            kwargs["geometry"] = geometry._replace(measure=partial(self._measure_beside_graphs, geometry, kept))
        actions = super().forward(*observation, runner="eager", **kwargs)
        kept.clear()
        return actions

    def _measure_beside_graphs(self, geometry: PendingGeometry, kept: list[Tensor]) -> Any:
        """Measure geometry in memory that is not the graphs': the needs of both add up.

        kept: holds the memory that was needed to measure until the chunk is done, where the graphs run later.
        """
        if not self._network.geometry_in_prefix:
            return with_memory_kept(self._counter, geometry.measure)
        tokens = geometry.measure()
        kept.append(torch.empty(self._counter.spare, dtype=torch.uint8))
        return tokens

    def _label_cache(self, _: Any, __: Any, given: Mapping[str, Any]) -> None:
        cache = given.get("past_key_values")
        if cache is not None:
            self._counter.label([cache.keys, cache.values], "cache")
