"""A tiny encoder with random weights, in memory and as a file with the released names."""

import dataclasses
from pathlib import Path

import torch
from safetensors.torch import save_file

from lerobot_policy_pi05_geometry.geometry.da3 import BACKBONE_PREFIX, VARIANTS, Da3Backbone, Da3Encoder

HEAD = {"model.head.scratch.weight": torch.ones(2, 3), "model.cam_dec.fc_t.bias": torch.ones(3)}


@torch.no_grad()
def tiny_backbone(seed: int = 0, name: str = "tiny", **changes) -> Da3Backbone:
    """Every parameter drawn anew: a fresh network's zeros and ones hide errors."""
    generator = torch.Generator().manual_seed(seed)
    backbone = Da3Backbone(dataclasses.replace(VARIANTS[name], **changes))
    for key, parameter in backbone.named_parameters():
        wide = key.endswith(("_token", "pos_embed")) or parameter.ndim == 1
        scale = 1.0 if wide else parameter[0].numel() ** -0.5
        parameter.copy_(scale * torch.randn(parameter.shape, generator=generator))
    return backbone


def single_view_backbone(seed: int = 0) -> Da3Backbone:
    """What mono-large is, as small as `tiny`."""
    return tiny_backbone(seed, "mono-large", width=32, depth=3, heads=2, out_layers=(1, 2))


def tiny_encoder(seed: int = 0, dtype: torch.dtype = torch.float32) -> Da3Encoder:
    return Da3Encoder(tiny_backbone(seed), dtype)


def write_tiny(path: Path, seed: int = 0, **changes: torch.Tensor | None) -> Path:
    """A file as released, with a head beside the backbone. changes: tensors by full name, or None to leave one out."""
    tensors = {BACKBONE_PREFIX + name: tensor for name, tensor in tiny_backbone(seed).state_dict().items()} | HEAD
    tensors |= changes
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items() if tensor is not None}, path)
    return path
