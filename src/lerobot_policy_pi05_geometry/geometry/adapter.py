"""The trainable bridge from geometry features to expert-width tokens."""

import torch
from torch import nn

from ..model.precision import Float32Linear, Float32Module, compute_in_float32
from ..model.segments import GeometryTokens
from .source import GeometryFeatures


class GeometryAdapter(Float32Module):
    """LayerNorm, a two-layer MLP, and learned row, column and view embeddings; stored and computed in float32.

    A bf16 adapter loses its small updates. The LayerNorm is there because sources differ in scale.
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
            tokens = self.fc_out(nn.functional.gelu(self.fc_in(self.norm(geometry.features.float()))))
            place = (self.row[:, None] + self.column[None]).flatten(0, 1)  # (G, W)
            tokens = tokens + place + self.view[:, None]
        return GeometryTokens(tokens.flatten(1, 2), geometry.valid.flatten(1, 2))
