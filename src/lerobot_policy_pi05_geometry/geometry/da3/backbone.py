"""The Depth Anything 3 backbone: a DINOv2 ViT/14 whose later blocks alternate between one view and all of them.

```
   patches + positions, cls token ─► blocks before alt_start: each view by itself
        cls := camera token (first view: reference; others)     at alt_start
                                  ─► even blocks: each view by itself, rotary positions (cls 0, patches from 1)
                                     odd blocks: all views together, rotary positions 0 (cls) and 1 (patches)
   features = output of the last within-view block ++ norm(output of this block)
```

A single-view model (alt_start None) has plain DINOv2 blocks, and norm(output) alone.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .blocks import Block, rotary_table
from .variants import PATCH, POSITIONS, Da3Variant

# DINOv2 interpolates its position embedding by a factor with this much added to the size; released weights expect it.
_INTERPOLATION_OFFSET = 0.1


class PatchEmbed(nn.Module):
    """Images (B, 3, H, W) -> patches (B, H/14 * W/14, D), row by row."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=PATCH, stride=PATCH)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images).flatten(2).mT


class Da3Backbone(nn.Module):
    """Parameters are named as in released files, under `model.backbone.pretrained.`."""

    def __init__(self, variant: Da3Variant) -> None:
        super().__init__()
        self.variant = variant
        width, start = variant.width, variant.alt_start
        self.patch_embed = PatchEmbed(width)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        if start is not None:
            self.camera_token = nn.Parameter(torch.zeros(1, 2, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + POSITIONS**2, width))
        self.blocks = nn.ModuleList(
            Block(width, variant.heads, qk_norm=start is not None and i >= start, swiglu=variant.swiglu)
            for i in range(variant.depth)
        )
        self.norm = nn.LayerNorm(width)

    def forward(self, images: Tensor, layers: tuple[int, ...] | None = None) -> list[Tensor]:
        """Features of every view.

        images: (B, V, 3, H, W), normalised by ImageNet's mean and deviation, sides multiples of 14; view 0 is the
        reference view. layers: blocks to read, in ascending order; None: the variant's `out_layers`.
        Returns per layer (B, V, H/14, W/14, F).
        """
        batch, views, _, height, width = images.shape
        if height % PATCH or width % PATCH:
            raise ValueError(
                f"Depth Anything 3 needs sides that are multiples of {PATCH}, got {height} x {width} pixels."
            )
        rows, columns = height // PATCH, width // PATCH
        layers = self.variant.out_layers if layers is None else layers
        start = self.variant.alt_start
        x = self.patch_embed(images.flatten(0, 1))
        # The residual stream has the embeddings' dtype, float32, also where products are computed in bf16.
        x = torch.cat([self.cls_token.expand(batch * views, -1, -1), x.to(self.cls_token.dtype)], dim=1)
        x = (x + self._positions(rows, columns)).unflatten(0, (batch, views))  # (B, V, N, D)
        within, across = self._rotary_tables(rows, columns, views, images.device)
        local, found = x, []
        for i, block in enumerate(self.blocks[: max(layers) + 1]):
            if i == start:
                x = torch.cat([self._camera_tokens(batch, views), x[:, :, 1:]], dim=2)
            if start is not None and i >= start and i % 2 == 1:
                x = block(x.flatten(1, 2), across).unflatten(1, (views, -1))
            else:
                rotary = within if start is not None and i >= start else None
                x = local = block(x.flatten(0, 1), rotary).unflatten(0, (batch, views))
            if i in layers:
                normed = self.norm(x)
                read = normed if start is None else torch.cat([local, normed], dim=-1)
                found.append(read[:, :, 1:].unflatten(2, (rows, columns)))
        return found

    def _positions(self, rows: int, columns: int) -> Tensor:
        """The learned position embedding for this many patches, (1, 1 + rows * columns, D) float32."""
        if rows == columns == POSITIONS:
            return self.pos_embed
        cls, patches = self.pos_embed.float().split([1, POSITIONS**2], dim=1)
        factors = [(side + _INTERPOLATION_OFFSET) / POSITIONS for side in (rows, columns)]
        patches = patches.mT.unflatten(2, (POSITIONS, POSITIONS))
        patches = F.interpolate(patches, scale_factor=factors, mode="bicubic")
        return torch.cat([cls, patches.flatten(2).mT], dim=1)

    def _camera_tokens(self, batch: int, views: int) -> Tensor:
        """(B, V, 1, D): the reference view's token, then the other views'."""
        reference, other = self.camera_token.unsqueeze(2).split(1, dim=1)  # (1, 1, 1, D) each
        return torch.cat([reference, other.expand(-1, views - 1, -1, -1)], dim=1).expand(batch, -1, -1, -1)

    def _rotary_tables(self, rows: int, columns: int, views: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Angles within a view (N, ...), and across views (V * N, ...), N = 1 + rows * columns."""
        head_dim = self.variant.width // self.variant.heads
        row = torch.arange(1, rows + 1, device=device)[:, None].expand(rows, columns)
        column = torch.arange(1, columns + 1, device=device).expand(rows, columns)
        places = F.pad(torch.stack([row, column], dim=-1).flatten(0, 1), (0, 0, 1, 0))  # the cls token stands at (0, 0)
        return rotary_table(places, head_dim), rotary_table(places.clamp_max(1).repeat(views, 1), head_dim)
