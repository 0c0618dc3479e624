"""The trainable map from geometry features to tokens of the action expert's width."""

import torch
from torch import Tensor, nn

from ..model.precision import Float32Linear, Float32Module, compute_in_float32
from ..model.segments import GeometryTokens
from .source import GeometryFeatures, GeometrySource

WAVELENGTHS = (1.0, 0.5, 0.25, 0.125, 0.0625)  # metres, of a point's Fourier features in `PointAdapter`
_HIDDEN = 128


class GeometryAdapter(Float32Module):
    """LayerNorm, a two-layer MLP, and learned row, column and view embeddings; stored and computed in float32.

    In bfloat16 small updates would be lost. The LayerNorm makes sources of different scale alike.
    """

    def __init__(self, feature_dim: int, width: int, grid: int, num_views: int) -> None:
        super().__init__()
        self.grid = grid
        self.norm = nn.LayerNorm(feature_dim)
        self.fc_in = Float32Linear(feature_dim, width)
        self.fc_out = Float32Linear(width, width)
        self.row = nn.Parameter(0.02 * torch.randn(grid, width))
        self.column = nn.Parameter(0.02 * torch.randn(grid, width))
        self.view = nn.Parameter(0.02 * torch.randn(num_views, width))

    def forward(self, geometry: GeometryFeatures) -> GeometryTokens:
        """Features (B, V, G, C) -> tokens (B, V * G, W) float32 and their padding mask (B, V * G) bool."""
        with compute_in_float32(geometry.features.device):
            tokens = self.embed(geometry.features.float())  # (B, V, G, W)
            position = (self.row[:, None] + self.column[None]).flatten(0, 1)  # (G, W)
            tokens = tokens + position + self.view[:, None]
        return GeometryTokens(tokens.flatten(1, 2), geometry.valid.flatten(1, 2))

    def embed(self, features: Tensor) -> Tensor:
        """Features of cells (..., C) -> (..., W)."""
        return self.fc_out(nn.functional.gelu(self.fc_in(self.norm(features))))


class PointAdapter(GeometryAdapter):
    """Pools the points of each cell: a point-wise MLP, and the maximum over the points that were measured.

    Source: PointNet (arXiv 1612.00593). A point goes in as its position, its offset from the mean of its cell, and Fourier
    features of the position.
    """

    def __init__(self, feature_dim: int, width: int, grid: int, num_views: int) -> None:
        super().__init__(_HIDDEN, width, grid, num_views)
        assert feature_dim % 4 == 0
        self.point_in = Float32Linear(6 + 6 * len(WAVELENGTHS), _HIDDEN)
        self.point_out = Float32Linear(_HIDDEN, _HIDDEN)

    def embed(self, features: Tensor) -> Tensor:
        """Points of cells (..., 4 N), each x, y, z and whether it was measured -> (..., W), a constant where there is none."""
        points = features.unflatten(-1, (-1, 4))  # (..., N, 4)
        known = points[..., 3:] > 0
        position = points[..., :3].masked_fill(~known, 0.0)
        mean = position.sum(dim=-2, keepdim=True) / known.sum(dim=-2, keepdim=True).clamp_min(1)
        angles = torch.cat([position * (2 * torch.pi / wavelength) for wavelength in WAVELENGTHS], dim=-1)
        given = torch.cat([position, position - mean, angles.sin(), angles.cos()], dim=-1)
        hidden = self.point_out(nn.functional.gelu(self.point_in(given)))  # (..., N, H)
        pooled = hidden.masked_fill(~known, torch.finfo(hidden.dtype).min).amax(dim=-2)
        return super().embed(pooled.masked_fill(~known.any(dim=-2), 0.0))


def make_adapter(source: GeometrySource, width: int) -> GeometryAdapter:
    """The adapter for what a source measures, to tokens of this width."""
    kind = PointAdapter if source.points else GeometryAdapter
    return kind(source.feature_dim, width, source.grid, len(source.cameras))
