"""The runner's chunks as CUDA graphs: kernels recorded once per shape of the inputs, then launched all at once.

```
   first chunk of a shape      copies of the inputs ─► look, act: run to warm up, then recorded
   every chunk of that shape   inputs ─► into the copies ─► look again ─► act again ─► a copy of the actions
                                           (geometry is measured in between, beside it: side_stream.py)
```

A recorded graph reads and writes fixed addresses. So inputs have buffers of their own, what the graphs compute (the cache among
it) stays where it was recorded, and nothing is allocated. Memory for what is only needed in passing is shared by all graphs,
since no two run at once. Prompts are padded to a multiple of `PROMPT_STEP` tokens: up to 200 tokens make 7 shapes, which all
fit into `CAPACITY`; the shape that was not used for longest makes room for a new one. Weights are read
where they lie, so new values act; when they lie elsewhere, or copies of them are out of date, all graphs are dropped.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Protocol

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from ..model.pi05 import PI05Pytorch
from ..model.segments import GeometryTokens
from .runner import Chunk, ChunkRunner, Observation

CAPACITY = 8  # shapes of inputs that stay recorded
PROMPT_STEP = 32  # tokens
_WARM_UP = 3  # runs before recording: libraries choose kernels and allocate workspaces


class Recorder(Protocol):
    """Makes work that computes tensors from tensors repeatable."""

    def record[T](self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """What `work` returns, its values not yet there; and what computes them, from the tensors that `work` has read."""
        ...


class CudaGraphRecorder:
    """CUDA graphs that share their memory."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()

    def record[T](self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        main = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(main)
        with torch.cuda.stream(self._stream):
            for _ in range(_WARM_UP):
                work()
        main.wait_stream(self._stream)  # warming up writes into a cache that the first replay writes into
        graph = torch.cuda.CUDAGraph()
        # What other threads do on the GPU in the meantime, those of cameras say, is no part of the graph and no error.
        with torch.cuda.graph(graph, pool=self._pool, stream=self._stream, capture_error_mode="thread_local"):
            result = work()
        return result, graph.replay


class Recorded[T]:
    """A recorded function. Calling it copies the tensors of its arguments into its buffers, and computes `result` anew."""

    def __init__(self, recorder: Recorder, function: Callable[..., T], *arguments: Any) -> None:
        # Buffers made in inference mode could be written to only there.
        with torch.inference_mode(False), torch.no_grad():
            buffers = tree_map(lambda x: x.clone() if isinstance(x, Tensor) else x, arguments)
            self._buffers = _tensors(buffers)
            self.result, self._replay = recorder.record(lambda: function(*buffers))

    def __call__(self, *arguments: Any) -> T:
        for buffer, given in zip(self._buffers, _tensors(arguments), strict=True):
            if buffer.shape != given.shape:  # of geometry, measured since; copying would repeat what is too small
                raise ValueError(f"Geometry tokens must be {tuple(buffer.shape)}, got {tuple(given.shape)}.")
            buffer.copy_(given, non_blocking=True)
        self._replay()
        return self.result


class GraphRunner(ChunkRunner):
    """A runner that records. new_recorder: called when there is nothing recorded, with the network's device."""

    def __init__(
        self,
        network: PI05Pytorch,
        new_recorder: Callable[[torch.device], Recorder] = CudaGraphRecorder,
        capacity: int = CAPACITY,
    ) -> None:
        self.recorded: OrderedDict[Hashable, Chunk] = OrderedDict()  # by shape, the one used last at the end
        self.capacity = capacity
        self._new_recorder = new_recorder
        super().__init__(network)

    def _build(self) -> None:
        self.recorded.clear()
        super()._build()

    def sample(self, images: Any, img_masks: Any, tokens: Tensor, masks: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        more = -tokens.shape[1] % PROMPT_STEP
        return super().sample(images, img_masks, F.pad(tokens, (0, more)), F.pad(masks, (0, more)), *args, **kwargs)

    def _chunk(self, observation: Observation, noise: Tensor, num_steps: int, num_tokens: int) -> Chunk:
        shapes = [(x.shape, x.dtype) if isinstance(x, Tensor) else None for x in tree_leaves((observation, noise))]
        key = (*shapes, num_steps, num_tokens)
        if key not in self.recorded:
            self._make_room()
            self.recorded[key] = self._record(
                super()._chunk(observation, noise, num_steps, num_tokens), observation, noise, num_tokens
            )
        self.recorded.move_to_end(key)
        return self.recorded[key]

    def _make_room(self) -> None:
        if len(self.recorded) == self.capacity:
            self.recorded.popitem(last=False)
        if not self.recorded:  # shared memory is gone with the last graph in it, and cannot be shared again
            self._recorder = self._new_recorder(self.device)

    def _record(self, chunk: Chunk, observation: Observation, noise: Tensor, num_tokens: int) -> Chunk:
        """The same chunk, from buffers. Geometry has not been measured yet, but its shape is known."""
        early = late = None
        if num_tokens:
            shape = (noise.shape[0], num_tokens)
            embs = torch.zeros(*shape, self.network.geometry_width, device=noise.device)
            blank = GeometryTokens(embs, torch.zeros(shape, dtype=torch.bool, device=noise.device))
            early, late = (blank, None) if self.network.geometry_in_prefix else (None, blank)
        look = Recorded(self._recorder, chunk.look, observation, early)
        act = Recorded(self._recorder, lambda *inputs: chunk.act(look.result, *inputs), noise, late)
        return Chunk(look, lambda context, *inputs: act(*inputs).clone())

    @property
    def _may_look(self) -> bool:
        return False  # a decision would be recorded, and taken for every other observation too


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]
