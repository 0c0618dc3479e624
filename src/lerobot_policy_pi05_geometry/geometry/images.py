"""RGB images in the layouts that LeRobot delivers -> one layout."""

import torch
from torch import Tensor


def rgb_image(image: Tensor, key: str) -> Tensor:
    """(B, 3, H, W) or (B, H, W, 3), uint8 or float in [0, 1] -> (B, 3, H, W) float32 in [0, 1].

    Raises ValueError, naming the key, for any other shape.
    """
    if image.ndim == 4 and image.shape[1] != 3 and image.shape[-1] == 3:
        image = image.permute(0, 3, 1, 2)
    if image.ndim != 4 or image.shape[1] != 3:
        raise ValueError(
            f"{key} must be RGB images (B, 3, H, W), got shape {tuple(image.shape)}; depth needs a name that ends in _depth."
        )
    return image.float() / 255 if image.dtype == torch.uint8 else image.float()
