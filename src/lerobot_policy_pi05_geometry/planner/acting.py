"""Sampling of action chunks on fake tensors: the runner and the plain path as they are, but for what needs values."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from ..inference.runner import ChunkRunner, Context, FlowTime, Observation
from ..inference.sampler import ChunkSampler
from ..inference.side_stream import SideStream
from ..model.pi05 import PI05Pytorch
from ..model.segment_cache import SegmentKVCache
from ..model.segments import GeometryTokens, Segment
from .counting import MemoryCounter

Target = Literal["cuda", "cpu"]


class CountedSide(SideStream):
    """What measures geometry beside recorded graphs: their memory is never its own, although nothing runs in it now."""

    def __init__(self, counter: MemoryCounter) -> None:
        super().__init__(torch.device("cpu"))
        self._counter = counter

    def run[T](self, work: Callable[[], T]) -> T:
        graphs_keep = torch.empty(self._counter.spare, dtype=torch.uint8)
        result = work()
        del graphs_keep
        return result


class CountedRunner(ChunkRunner):
    """A runner whose matrices are weights and whose cache is a cache to the counter."""

    def __init__(self, network: PI05Pytorch, counter: MemoryCounter, target: Target, graphs: bool) -> None:
        self._counter, self._target, self._graphs = counter, target, graphs
        super().__init__(network)

    def _build(self) -> None:
        with self._counter.naming("weights"):
            super()._build()
        if self._graphs:
            self._side = CountedSide(self._counter)

    def refresh(self) -> None:
        """Nothing: there are no values to compare, and no weight changes while one chunk is planned."""

    def _schedule(self, segment: Segment, num_steps: int) -> list[FlowTime]:
        """All that there will be, however few steps are run here."""
        return super()._schedule(segment, self.config.num_inference_steps)[:num_steps]

    def look(self, observation: Observation, geometry: GeometryTokens | None, room: tuple[int, int]) -> Context:
        """Geometry that was measured before has used memory that is not the graph's: the two add up in this order, too."""
        look = partial(super().look, observation, geometry, room)
        return look() if geometry is None else self._side.run(look)

    def _make_cache(self, batch: int, lengths: tuple[int, int, int]) -> SegmentKVCache:
        cache = super()._make_cache(batch, lengths)
        self._counter.label([cache.keys, cache.values], "cache")
        return cache

    @property
    def kernels(self) -> str:
        return self._target

    @property
    def _may_look(self) -> bool:
        return False  # there are no values to look at; prompts are padded in general


class CountedSampler(ChunkSampler):
    """The sampler of a planned policy, which tells the counter what the cache is, whichever path computes the chunk."""

    def __init__(self, network: PI05Pytorch, counter: MemoryCounter, target: Target) -> None:
        super().__init__(network)
        self._counter, self._target = counter, target

    def __call__(self, *observation: Any, **kwargs: Any) -> Tensor:
        self._graphs = self._target == "cuda" and kwargs.get("runner") == "fast"
        hook = self._network.paligemma_with_expert.register_forward_pre_hook(self._label_cache, with_kwargs=True)
        chunk = super().__call__(*observation, **kwargs)
        hook.remove()
        return chunk

    def _make_runner(self, kind: type[ChunkRunner]) -> ChunkRunner:
        return CountedRunner(self._network, self._counter, self._target, self._graphs)

    def _label_cache(self, _: Any, __: Any, given: Mapping[str, Any]) -> None:
        cache = given.get("past_key_values")
        if cache is not None:
            self._counter.label([cache.keys, cache.values], "cache")
