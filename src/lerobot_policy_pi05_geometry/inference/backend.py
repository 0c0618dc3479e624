"""What the runner has to know of the device that it runs on. The planner and tests pass a backend of their own."""

from collections.abc import Sequence

import torch

from ..model.paligemma_with_expert import PaliGemmaWithExpert
from ..model.segment_cache import SegmentKVCache
from .recorder import CudaGraphRecorder, Recorder
from .side_stream import SideStream


class Backend:
    """The choices that depend on the device. kernels: type of device whose kernels are assumed, such as "cpu" or "cuda"."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.kernels = device.type

    @property
    def can_record(self) -> bool:
        """Whether chunks can be recorded as graphs."""
        return self.kernels == "cuda"

    def new_recorder(self) -> Recorder:
        """A recorder whose recordings share their memory."""
        return CudaGraphRecorder(self.device)

    def new_side_stream(self) -> SideStream:
        """Where geometry is measured."""
        return SideStream(self.device)

    def new_cache(self, network: PaliGemmaWithExpert, batch: int, lengths: Sequence[int]) -> SegmentKVCache:
        """An empty cache of keys and values for segments of these lengths."""
        return network.make_cache(batch, lengths, self.device)

    def attention_in_products(self, dtype: torch.dtype) -> bool:
        """Whether two products and a softmax are faster than PyTorch's fused attention (benchmarks/attention.py)."""
        return self.kernels == "cpu" and dtype == torch.bfloat16

    def mask_dtype(self, dtype: torch.dtype) -> torch.dtype:
        """Dtype of additive masks beside queries of `dtype`.

        Float32 keeps the digits of the gate. CUDA has no fast kernel for a float32 mask beside bf16 queries.
        """
        return torch.float32 if self.kernels == "cpu" else dtype
