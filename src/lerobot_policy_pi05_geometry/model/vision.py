"""SigLIP (from transformers) and the projector into the VLM; all cameras in one batch."""

from collections.abc import Callable

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


def embed_images(
    tower: SiglipVisionModel, projector: Projector, images: Tensor, call_layer: Callable[..., Tensor]
) -> Tensor:
    """Images (N, 3, H, W) in [-1, 1] -> patch embeddings (N, patches, W_vlm).

    call_layer: calls a layer of the tower with its arguments (hidden states, and None for the mask).
    """
    vision = tower.vision_model
    if not torch.is_autocast_enabled(images.device.type):
        images = images.to(vision.embeddings.patch_embedding.weight.dtype)
    hidden = vision.embeddings(images)
    for layer in vision.encoder.layers:
        hidden = call_layer(layer, hidden, None)
    return projector(vision.post_layernorm(hidden))
