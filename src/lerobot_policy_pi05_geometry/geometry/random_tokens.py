"""The control for experiments: as many geometry tokens, without information about the scene."""

from collections.abc import Mapping

import torch
from torch import Tensor

from .keys import batch_like
from .rgbd import FEATURE_DIM
from .source import GeometryFeatures, GeometrySource

_SEED = 20250101


class RandomSource(GeometrySource):
    """Fixed standard-normal features, the same for every observation and every run."""

    def __init__(self, cameras: tuple[str, ...], grid: int, feature_dim: int = FEATURE_DIM) -> None:
        super().__init__()
        self.cameras, self.grid, self.feature_dim = cameras, grid, feature_dim
        generator = torch.Generator().manual_seed(_SEED)
        shape = (1, len(cameras), grid**2, feature_dim)
        # On the CPU also under `torch.device(...)`, as the generator is: every machine draws the same.
        self._features = torch.randn(shape, generator=generator, device="cpu")

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return []

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        like = batch_like(batch)
        self._features = self._features.to(like.device)
        features = self._features.expand(like.shape[0], -1, -1, -1)
        return GeometryFeatures(features, torch.ones(features.shape[:3], dtype=torch.bool, device=like.device))
