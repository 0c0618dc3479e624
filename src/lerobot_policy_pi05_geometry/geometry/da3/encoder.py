"""The frozen backbone: raw images in, features out."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from ...model.precision import compute_in
from .backbone import Da3Backbone

# ImageNet's mean and standard deviation per channel, for images in [0, 1].
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)


class Da3Encoder(nn.Module):
    """Always in evaluation mode, without gradients, computing in `dtype` whatever autocast is on in its caller.

    content_hash: SHA-256 of the backbone's released tensors, None for weights that come from no file.
    """

    def __init__(
        self, backbone: Da3Backbone, dtype: torch.dtype = torch.bfloat16, content_hash: str | None = None
    ) -> None:
        super().__init__()
        self.content_hash = content_hash
        self.variant, self.dtype = backbone.variant, dtype
        self.backbone = backbone.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION).view(3, 1, 1), persistent=False)
        self.train(False)

    def train(self, mode: bool = True) -> "Da3Encoder":
        """Stay in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, images: Tensor) -> Tensor:
        """Features of the last block: images (B, V, 3, H, W) float32 in [0, 1] -> (B, V, H/14, W/14, F) float32."""
        with compute_in(self.dtype, images.device):
            (features,) = self.backbone((images - self.mean) / self.deviation, (self.variant.depth - 1,))
        return features.float()


def store_products_in(backbone: Da3Backbone, dtype: torch.dtype) -> None:
    """Store the weights of matrix products in the dtype they are used in; norms, scales and embeddings stay float32.

    The result is that of autocast, bit for bit. Autocast caches casts of trainable weights only, so it would cast frozen
    ones at every call. It also halves the memory.
    """
    for module in backbone.modules():
        if isinstance(module, nn.Linear | nn.Conv2d):
            module.to(dtype)


def resize(images: Tensor, size: int) -> Tensor:
    """Images (B, 3, H, W) in [0, 1] -> (B, 3, size, size), both sides scaled to fit, without padding."""
    if images.shape[-2:] == (size, size):
        return images
    return F.interpolate(images, size=(size, size), mode="bicubic", antialias=True).clamp(0.0, 1.0)
