"""SigLIP (from transformers) and the projector into the VLM; all cameras in one batch."""

import torch
from torch import Tensor, nn
from transformers import SiglipVisionConfig, SiglipVisionModel

from .variants import PaliGemmaVariant


class Projector(nn.Module):
    """Linear map from vision width to VLM width."""

    def __init__(self, vision_width: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(vision_width, width)

    def forward(self, features: Tensor) -> Tensor:
        return self.linear(features)


def build_vision_tower(variant: PaliGemmaVariant, image_size: int) -> SiglipVisionModel:
    """A SigLIP tower without its pooling head, as PaliGemma uses it."""
    vision = variant.vision
    return SiglipVisionModel(
        SiglipVisionConfig(  # type: ignore[call-arg]
            hidden_size=vision.width,
            intermediate_size=vision.mlp_dim,
            num_hidden_layers=vision.depth,
            num_attention_heads=vision.num_heads,
            patch_size=vision.patch_size,
            image_size=image_size,
            vision_use_head=False,
        )
    )


def embed_images(tower: SiglipVisionModel, projector: Projector, images: Tensor) -> Tensor:
    """Images (N, 3, H, W) in [-1, 1] -> patch embeddings (N, patches, W_vlm)."""
    weight = tower.vision_model.embeddings.patch_embedding.weight
    if not torch.is_autocast_enabled(images.device.type):
        images = images.to(weight.dtype)
    return projector(tower(images).last_hidden_state)
