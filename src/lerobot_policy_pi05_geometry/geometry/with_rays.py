"""Features of RGB cameras beside where each cell's camera ray starts and points: what the image shows, and from where."""

from collections.abc import Mapping

import torch
from torch import Tensor

from .rays import RaySource
from .source import GeometryFeatures, GeometrySource


class WithRays(GeometrySource):
    """A source's features, and those of `RaySource` after them: (B, V, G, C + rays).

    Both see the same cameras on the same grid. A camera whose pose is missing keeps its features, beside zeros.
    """

    def __init__(self, source: GeometrySource, rays: RaySource) -> None:
        super().__init__()
        assert (source.cameras, source.grid) == (rays.cameras, rays.grid)
        self.source, self.rays = source, rays
        self.cameras, self.grid, self.optional = source.cameras, source.grid, source.optional
        self.feature_dim, self.across_views = source.feature_dim + rays.feature_dim, source.across_views

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return self.source.missing_cameras(batch)

    def missing_message(self, cameras: list[str]) -> str:
        return self.source.missing_message(cameras)

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        """See `GeometrySource.forward`. In training, a pose that is missing is an error."""
        without = self.rays.missing_cameras(batch)
        if self.training and without:
            raise ValueError(self.rays.missing_message(without))
        seen, rays = self.source(batch, check), self.rays(batch, check)
        features = torch.cat([seen.features, rays.features.to(seen.features)], dim=-1)
        return GeometryFeatures(features.masked_fill(~seen.valid[..., None], 0.0), seen.valid)
