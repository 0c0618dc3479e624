"""The policy as the planner runs it: LeRobot's batches without values, so nothing may read one."""

from collections.abc import Mapping, Set
from dataclasses import replace

import torch
from torch import Tensor

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..data.images import ImageRangeCheck
from ..geometry import GeometryEncoder, GeometrySource
from ..geometry.da3 import Da3Encoder
from ..geometry.source import GeometryFeatures
from ..model.flow_matching import FlowDraw
from ..model.precision import compute_in_float32
from ..model.segments import GeometryTokens
from ..modeling_pi05_geometry import PI05GeometryPolicy


class StoredFeatures(GeometrySource):
    """A feature store in training: features in bfloat16 on the device, and in float32 for the adapter."""

    def __init__(self, cameras: tuple[str, ...], grid: int, feature_dim: int, optional: Set[str]) -> None:
        super().__init__()
        self.cameras, self.grid, self.feature_dim, self.optional = cameras, grid, feature_dim, frozenset(optional)

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return []

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        shape = (batch["action"].shape[0], len(self.cameras), self.grid**2)
        features = torch.zeros(*shape, self.feature_dim, dtype=torch.bfloat16).float()
        return GeometryFeatures(features, torch.ones(shape, dtype=torch.bool))


class PlannedGeometry(GeometryEncoder):
    """Source and adapter, without the checks of measurements, which have no values here."""

    def forward(self, batch: Mapping[str, Tensor]) -> GeometryTokens:
        with compute_in_float32(torch.device("cpu")):
            tokens: GeometryTokens = self.adapter(self.source(batch, check=False))
        return tokens


class PlannedImages(ImageRangeCheck):
    """No check: the images have no values here."""

    def __call__(self, batch: Mapping[str, Tensor], config: PI05GeometryConfig) -> None:
        """Look at nothing."""


class PlannedPolicy(PI05GeometryPolicy):
    """The real policy, but for what needs values: drawing noise, checking measurements, reading a feature store."""

    def __init__(self, config: PI05GeometryConfig, encoder: Da3Encoder | None) -> None:
        stored = config.geometry_source == "features"  # the encoder has the same cameras, cells and width
        super().__init__(replace(config, geometry_source="da3") if stored else config, encoder=encoder)
        self.image_range = PlannedImages()
        self.config.use_relative_actions = False  # planned batches are made without processors; no memory depends on it
        if self.geometry is None:
            return
        source = self.geometry.source
        if stored:
            assert encoder is not None
            cameras, optional = tuple(config.rgb_cameras()), config.optional_rgb_cameras()
            source = StoredFeatures(cameras, config.geometry_grid, encoder.variant.feature_dim, optional)
        self.geometry = PlannedGeometry(source, self.model.geometry_width)

    def loss(self, batch: dict[str, Tensor], whole: int) -> Tensor:
        """The share of these rows in the loss of a batch of `whole` samples."""
        size, steps = batch["action"].shape[:2]
        samples = () if self.config.flow_samples == 1 else (self.config.flow_samples,)
        noise = torch.zeros(size, *samples, steps, self.config.max_action_dim)
        zeros = torch.zeros(size)
        draw = FlowDraw(
            noise, torch.zeros(size, *samples), dropout=zeros, camera=zeros, delay=zeros.long(), key=zeros.long()
        )
        losses = self._losses(batch, draw)[0][..., : self.config.action_feature.shape[0]]
        valid = torch.ones(losses.shape[:2], dtype=torch.bool)
        return losses.masked_fill(~valid[..., None], 0.0).sum() / (whole * losses[0].numel())
