"""The source of a converted checkpoint before training: the cameras of its geometry are not known yet."""

import logging
from collections.abc import Mapping

import torch
from torch import Tensor

from .keys import batch_like
from .rgbd import FEATURE_DIM
from .source import GeometryFeatures, GeometrySource

logger = logging.getLogger(__name__)


class UnknownCameras(GeometrySource):
    """As many tokens as the later source gives, all masked: the policy acts as the π0.5 that it was converted from.


    feature_dim, points: of the source that will take this one's place, by default of `RgbdSource`.
    """

    def __init__(self, cameras: tuple[str, ...], grid: int, feature_dim: int = FEATURE_DIM, points: int = 0) -> None:
        super().__init__()
        self.cameras, self.grid, self.feature_dim, self.points = cameras, grid, feature_dim, points
        self.optional = frozenset(cameras)  # none of them is there, and none has failed
        self._warned = False

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return []

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        if self.training:
            raise ValueError(
                "A converted checkpoint learns its geometry cameras from a dataset: build it with LeRobot's make_policy and "
                "the dataset's metadata, as lerobot-train does."
            )
        if not self._warned:
            self._warned = True
            logger.warning(
                "This checkpoint has not been trained on data with its geometry cameras yet, so it acts without geometry, as "
                "the π0.5 that it was converted from; train it with lerobot-train --policy.path on data that has them."
            )
        like = batch_like(batch)
        shape = (like.shape[0], len(self.cameras), self.grid**2)
        return GeometryFeatures(
            torch.zeros(*shape, self.feature_dim, device=like.device),
            torch.zeros(shape, dtype=torch.bool, device=like.device),
        )
