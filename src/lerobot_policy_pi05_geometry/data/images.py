"""RGB images in the form that SigLIP expects."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from torch import Tensor

from ..geometry.images import rgb_image

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig

RANGE_TOLERANCE = 0.02  # what resizing with cubic interpolation or a video codec may overshoot


def prepare_images(
    batch: Mapping[str, Tensor], config: "PI05GeometryConfig", device: torch.device
) -> tuple[list[Tensor | None], list[Tensor]]:
    """The RGB cameras of a batch as SigLIP's inputs.

    Images are (B, 3, H, W) or (B, H, W, 3), uint8 or float in [0, 1]; they are resized with black padding to
    `image_resolution` and scaled to [-1, 1], as openpi does.

    Returns per camera the images (B, 3, S, S) float32, or None for a camera that may be absent and is, and its mask (B,).
    Raises ValueError for a camera that is missing or has a wrong shape.
    """
    images: list[Tensor | None] = []
    masks = []
    size = batch["observation.language.tokens"].shape[0]
    for key in config.image_features:
        absent = key not in batch
        if absent and not config.may_be_absent(key):
            raise ValueError(
                f"The observation has no image {key}; connect the camera, rename its key with --rename_map, or, if "
                f"this policy may run without it, list it in --policy.absent_cameras='[\"{key}\"]'."
            )
        images.append(None if absent else _prepare_image(batch[key].to(device), key, config))
        masks.append(torch.full((size,), not absent, device=device))
    return images, masks


class ImageRangeCheck:
    """Checks once per episode, and once per training run, that float images are in [0, 1].

    Images in 0..255 or in [-1, 1] have the right shape and type, so nothing else would notice them.
    """

    def __init__(self) -> None:
        self._done = False

    def reset(self) -> None:
        """Check the next batch again."""
        self._done = False

    def __call__(self, batch: Mapping[str, Tensor], config: "PI05GeometryConfig") -> None:
        """Raises ValueError naming the camera and what its values say about their scale."""
        if self._done:
            return
        for key in config.image_features:
            if key in batch and batch[key].dtype != torch.uint8 and batch[key].numel():
                _require_unit_range(batch[key], key)
        self._done = True


def _require_unit_range(image: Tensor, key: str) -> None:
    low, high = (bound.item() for bound in image.aminmax())
    if low >= -RANGE_TOLERANCE and high <= 1 + RANGE_TOLERANCE:  # false for NaN
        return
    hint = " (was it scaled to 0..255?)" if high > 2 else " (was it scaled to [-1, 1]?)" if low < 0 else ""
    raise ValueError(f"{key} has values from {low:g} to {high:g}{hint}; give images as uint8, or as floats in [0, 1].")


def _prepare_image(image: Tensor, key: str, config: "PI05GeometryConfig") -> Tensor:
    image = rgb_image(image, key)
    if tuple(image.shape[-2:]) != tuple(config.image_resolution):
        image = resize_with_pad_torch(image, *config.image_resolution)
    return image * 2.0 - 1.0
