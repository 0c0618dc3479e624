"""Settings of the network."""

from dataclasses import dataclass
from typing import Literal

import torch

from .variants import GemmaVariant, PaliGemmaVariant

GeometryTime = Literal["clean", "denoise"]
GeometryPositions = Literal["sequential", "parallel"]
GeometryPlacement = Literal["segment", "prefix"]
GeometryExpert = Literal["shared", "own"]
RunnerName = Literal["fast", "eager", "plain"]  # the runner, on a GPU as CUDA graphs; without graphs; the plain path
RtcMode = Literal["guided", "trained"]  # real-time chunking, see real_time_chunking.py


@dataclass(frozen=True)
class GeometrySegmentConfig:
    """How geometry tokens take part in attention (see docs/architecture.md).

    time: flow time that modulates geometry's adaRMS: "clean" is 0 at every step, so that its keys and values are cached
        exactly; "denoise" is the current step, recomputed each step (for comparison).
    positions: "sequential" counts P|G|S; "parallel" gives the suffix the positions it would have without geometry.
    placement: "segment" between prefix and suffix, or "prefix" inside the VLM's own prefix (for comparison).
    expert: "shared" uses the action expert's weights, "own" a second expert that starts as its copy.
    openness: what the gate starts with, the factor on the suffix's softmax weight on geometry; 1 is open, 1e-7 closed.
    """

    time: GeometryTime = "clean"
    positions: GeometryPositions = "sequential"
    placement: GeometryPlacement = "segment"
    expert: GeometryExpert = "shared"
    openness: float = 1.0


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes, flow-matching settings and dtypes of a `PI05Pytorch`.

    dtype: compute dtype. param_dtype: storage dtype of everything that `precision.py` does not keep in float32.
    geometry: None builds plain π0.5.
    rtc_training_max_delay: action steps of the longest hard prefix in training; 0 for none (real_time_chunking.py).
    """

    paligemma: PaliGemmaVariant
    expert: GemmaVariant
    image_size: int
    chunk_size: int
    max_action_dim: int
    num_inference_steps: int = 10
    min_period: float = 4e-3
    max_period: float = 4.0
    dtype: torch.dtype = torch.float32
    param_dtype: torch.dtype = torch.float32
    geometry: GeometrySegmentConfig | None = None
    rtc_training_max_delay: int = 0

    def __post_init__(self) -> None:
        vlm = self.paligemma.gemma
        for name in ("depth", "num_heads", "num_kv_heads", "head_dim"):
            if getattr(vlm, name) != getattr(self.expert, name):
                raise ValueError(
                    f"The VLM and the action expert share one attention, so they need the same {name}; got "
                    f"{getattr(vlm, name)} and {getattr(self.expert, name)}. Choose variants of one family "
                    "(gemma_2b with gemma_300m, small with small, tiny with tiny)."
                )
        if self.param_dtype == torch.bfloat16 and self.dtype == torch.float32:
            raise ValueError(
                "param_dtype=bfloat16 needs dtype=bfloat16: float32 products of bf16 weights gain nothing."
            )
        if self.image_size % self.paligemma.vision.patch_size:
            raise ValueError(
                f"image_resolution must be a multiple of the vision tower's patch size "
                f"{self.paligemma.vision.patch_size}, got {self.image_size}."
            )
