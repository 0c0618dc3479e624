"""The policy as the planner runs it: LeRobot's batches without values, so nothing looks into them."""

from collections.abc import Mapping, Set
from typing import Any

import torch
from torch import Tensor

from ..geometry import GeometrySource
from ..geometry.da3 import Da3Encoder
from ..geometry.source import GeometryFeatures
from ..model.flow_matching import FlowDraw
from ..model.precision import compute_in_float32
from ..model.segments import GeometryTokens
from ..modeling_pi05_geometry import PI05GeometryPolicy


class StoredFeatures(GeometrySource):
    """What a feature store hands over in training: bfloat16 on the device, and float32 for the adapter."""

    def __init__(self, cameras: tuple[str, ...], grid: int, feature_dim: int, optional: Set[str]) -> None:
        super().__init__()
        self.cameras, self.grid, self.feature_dim, self.optional = cameras, grid, feature_dim, frozenset(optional)

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return []

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        shape = (batch["action"].shape[0], len(self.cameras), self.grid**2)
        features = torch.zeros(*shape, self.feature_dim, dtype=torch.bfloat16).float()
        return GeometryFeatures(features, torch.ones(shape, dtype=torch.bool))


class PlannedPolicy(PI05GeometryPolicy):
    """The real policy, but for what needs values: drawing noise, and checking measurements."""

    def _build_source(self, dataset_meta: Any | None, encoder: Da3Encoder | None) -> GeometrySource | None:
        if self.config.geometry_source != "features":
            return super()._build_source(dataset_meta, encoder)
        assert encoder is not None
        cameras, optional = tuple(self.config.rgb_cameras()), self.config.optional_rgb_cameras()
        return StoredFeatures(cameras, self.config.geometry_grid, encoder.variant.feature_dim, optional)

    def _measure(self, batch: dict[str, Tensor]) -> GeometryTokens:
        assert self.geometry is not None
        with compute_in_float32(torch.device("cpu")):
            tokens: GeometryTokens = self.geometry.adapter(self.geometry.source(batch, check=False))
        return tokens

    def loss(self, batch: dict[str, Tensor], whole: int) -> Tensor:
        """What rows of a batch of `whole` samples add to its loss."""
        size, steps = batch["action"].shape[:2]
        samples = () if self.config.flow_samples == 1 else (self.config.flow_samples,)
        noise = torch.zeros(size, *samples, steps, self.config.max_action_dim)
        draw = FlowDraw(noise, torch.zeros(size, *samples), dropout=torch.zeros(size), camera=torch.zeros(size))
        losses = self._losses(batch, draw)[..., : self.config.action_feature.shape[0]]
        valid = torch.ones(losses.shape[:2], dtype=torch.bool)
        return losses.masked_fill(~valid[..., None], 0.0).sum() / (whole * losses[0].numel())
