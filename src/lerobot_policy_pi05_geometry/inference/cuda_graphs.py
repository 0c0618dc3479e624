"""The runner's chunks as CUDA graphs: kernels recorded once per shape of the inputs, then launched all at once.

```
   first chunk of a shape      copies of the inputs ─► prefill, denoise: run to warm up, then recorded
   every chunk of that shape   inputs ─► into the copies ─► prefill again ─► denoise again ─► a copy of the actions
                                           (geometry is measured in between, on another stream: side_stream.py)
```

A recorded graph reads and writes fixed addresses. So inputs have buffers of their own, what the graphs compute (the cache among
it) stays where it was recorded, and nothing is allocated. All graphs share the memory of their intermediates, since no two run at
the same time. Prompts are padded to a multiple of `PROMPT_STEP` tokens: up to 200 tokens make 7 shapes, which all fit into
`CAPACITY`. When it is full, the shape that was not used for longest is dropped; `reserve` makes it larger.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from ..model.pi05 import PI05Pytorch
from ..model.real_time_chunking import Guidance, HardPrefix
from ..model.segments import GeometryTokens
from .backend import Backend
from .recorder import Recorder
from .runner import ChunkFunctions, ChunkRunner, ChunkSettings, Observation, observation_key
from .side_stream import PendingGeometry

CAPACITY = 8  # shapes of inputs that stay recorded
PROMPT_STEP = 32  # tokens


class Recorded[T]:
    """A recorded function. A call copies the tensors of its arguments into its buffers and computes `result` anew."""

    def __init__(self, recorder: Recorder, function: Callable[..., T], *arguments: Any) -> None:
        # Buffers made in inference mode could be written to only in inference mode.
        with torch.inference_mode(False), torch.no_grad():
            buffers = tree_map(lambda x: x.clone() if isinstance(x, Tensor) else x, arguments)
            self._buffers = _tensors(buffers)
            self.result, self._replay = recorder.record(lambda: function(*buffers))

    def __call__(self, *arguments: Any) -> T:
        for buffer, given in zip(self._buffers, _tensors(arguments), strict=True):
            if buffer.shape != given.shape:  # of geometry, measured since; `copy_` would repeat what is too small
                raise ValueError(f"Geometry tokens must be {tuple(buffer.shape)}, got {tuple(given.shape)}.")
            buffer.copy_(given, non_blocking=True)
        self._replay()
        return self.result


class GraphRunner(ChunkRunner):
    """A runner that records. capacity: shapes of inputs that stay recorded."""

    def __init__(self, network: PI05Pytorch, backend: Backend | None = None, capacity: int = CAPACITY) -> None:
        self.recorded: OrderedDict[Hashable, ChunkFunctions] = OrderedDict()  # by shape, the one used last at the end
        self.capacity = capacity
        super().__init__(network, backend)

    def __call__(self, images: Any, img_masks: Any, tokens: Tensor, masks: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        more = -tokens.shape[1] % PROMPT_STEP
        return super().__call__(images, img_masks, F.pad(tokens, (0, more)), F.pad(masks, (0, more)), *args, **kwargs)

    def reserve(self, shapes: int) -> None:
        """Keep so many shapes of inputs or more."""
        self.capacity = max(self.capacity, shapes)

    def has_recorded(
        self,
        images: Sequence[Tensor | None],
        img_masks: Sequence[Tensor],
        tokens: Tensor,
        masks: Tensor,
        noise: Tensor,
        geometry: PendingGeometry | None = None,
        num_steps: int | None = None,
    ) -> bool:
        """Whether a chunk of these shapes with nothing left over is recorded; arguments as in a call."""
        more = -tokens.shape[1] % PROMPT_STEP
        observation = Observation(images, img_masks, F.pad(tokens, (0, more)), F.pad(masks, (0, more)))
        previous = self._previous_chunk(noise, None, None, None)
        return _key(observation, noise, previous, self._settings(noise, num_steps, geometry)) in self.recorded

    def _functions(
        self, observation: Observation, noise: Tensor, previous: Guidance | HardPrefix | None, settings: ChunkSettings
    ) -> ChunkFunctions:
        key = _key(observation, noise, previous, settings)
        if key not in self.recorded:
            self._drop_oldest()
            plain = super()._functions(observation, noise, previous, settings)
            self.recorded[key] = self._record(plain, observation, noise, previous, settings)
        self.recorded.move_to_end(key)
        return self.recorded[key]

    def _drop_oldest(self) -> None:
        if len(self.recorded) >= self.capacity:
            self.recorded.popitem(last=False)
        if not self.recorded:  # shared memory is freed with the last graph in it, and cannot be shared again
            self._recorder = self.backend.new_recorder()

    def _record(
        self,
        chunk: ChunkFunctions,
        observation: Observation,
        noise: Tensor,
        previous: Guidance | HardPrefix | None,
        settings: ChunkSettings,
    ) -> ChunkFunctions:
        """The same chunk, from buffers. Geometry has not been measured yet, but its shape is known."""
        early = late = None
        if settings.geometry_tokens:
            shape = (noise.shape[0], settings.geometry_tokens)
            embs = torch.zeros(*shape, self.network.geometry_width, device=noise.device)
            blank = GeometryTokens(embs, torch.zeros(shape, dtype=torch.bool, device=noise.device))
            early, late = (blank, None) if self.network.geometry_in_prefix else (None, blank)
        prefill = Recorded(self._recorder, chunk.prefill, observation, early)
        denoise = Recorded(
            self._recorder, lambda *inputs: chunk.denoise(prefill.result, *inputs), noise, late, previous
        )
        return ChunkFunctions(prefill, lambda context, *inputs: denoise(*inputs).clone())


def _key(
    observation: Observation, noise: Tensor, previous: Guidance | HardPrefix | None, settings: ChunkSettings
) -> Hashable:
    return (*observation_key(*tree_leaves((observation, noise, previous))), settings)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]
