"""Modality dropout: training samples that go without their images, their geometry, or one camera.

A policy that acts from RGB takes geometry up only where RGB is missing, and one that learns geometry first acts without it
only where that was missing. (VGDP, arXiv 2511.22445, credits most of its robustness to dropping RGB at random.) One draw decides
what a sample goes without, so it is one thing at most:

```
   0          geometry_dropout        + camera_dropout               1 - image_dropout          1
   ├── no geometry ──┼── without one camera ──┼────── everything ──────┼── no images ──┤
```

Nothing is taken from a sample that has nothing else to see by: no geometry where no image is there, no images where no cell of
geometry is valid, no camera that is the only one.

Shapes: B batch, I RGB cameras, V geometry cameras, G cells of one, N cameras in all.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..model.flow_matching import FlowDraw


class DropoutRates(NamedTuple):
    """Probabilities, at most 1 together. All 0: nothing is dropped."""

    geometry: float
    images: float
    camera: float


class Cameras(NamedTuple):
    """Names of the cameras behind the images and behind the geometry, in their order; one that gives both is named in both.

    across_views: whether a cell's features come from all geometry cameras of a sample (Depth Anything 3), so that what is
    seen without one of them cannot be known from the cells of the others.
    """

    images: Sequence[str]
    geometry: Sequence[str]
    across_views: bool


def check_camera_names(cameras: Cameras, rates: DropoutRates) -> None:
    """Raise ValueError if a camera is to be taken away, image and geometry, and no image has the name of a geometry camera."""
    if rates.camera and cameras.images and cameras.geometry and not set(cameras.images) & set(cameras.geometry):
        raise ValueError(
            f"camera_dropout takes away a camera's image and its geometry, but no image ({', '.join(cameras.images)}) has the "
            f"name of a geometry camera ({', '.join(cameras.geometry)}), as after a --rename_map of the images; rename the "
            "cameras in the dataset, or set --policy.camera_dropout=0."
        )


def drop(
    draw: FlowDraw, rates: DropoutRates, cameras: Cameras, img_masks: Sequence[Tensor], geom_pad: Tensor | None
) -> tuple[list[Tensor], Tensor | None]:
    """Masks of a training batch with what its draw takes away. No values are looked at, so no GPU is waited for.

    draw: `dropout` and `camera` (B,). img_masks: I masks (B,) bool. geom_pad: (B, V * G) bool, or None without geometry.
    Returns both, masked further.
    """
    if not any(rates) or not img_masks:
        return list(img_masks), geom_pad
    device = img_masks[0].device
    u, which = draw.dropout.to(device), draw.camera.to(device)
    images = torch.stack(list(img_masks), dim=1)  # (B, I)
    none = torch.zeros(len(images), 0, 1, dtype=torch.bool, device=device)
    cells = none if geom_pad is None else geom_pad.unflatten(1, (len(cameras.geometry), -1))  # (B, V, G)

    geometry_drawn = u < rates.geometry
    camera_drawn = ~geometry_drawn & (u < rates.geometry + rates.camera)
    images_drawn = ~geometry_drawn & ~camera_drawn & (u >= 1 - rates.images)
    lost_images = (images_drawn & cells.flatten(1).any(dim=1))[:, None]
    lost_cells = (geometry_drawn & images.any(dim=1))[:, None]
    if rates.camera:
        of_image, of_cells = _one_camera(which, cameras, images, cells.any(dim=2))
        lost_images = lost_images | (camera_drawn[:, None] & of_image)
        lost_cells = lost_cells | (camera_drawn[:, None] & of_cells)
    cells = cells & ~lost_cells[..., None]
    return list((images & ~lost_images).unbind(1)), None if geom_pad is None else cells.flatten(1)


def went_without(before: tuple[Sequence[Tensor], Tensor], after: tuple[Sequence[Tensor], Tensor]) -> Tensor:
    """(B, 2) bool: samples from which all geometry was taken, and samples from which all images were.

    before, after: I masks (B,) and geom_pad, as `drop` gets and returns them.
    """
    return _has(*before) & ~_has(*after)


def _has(img_masks: Sequence[Tensor], geom_pad: Tensor) -> Tensor:
    """(B, 2) bool: whether a sample has any geometry, and any image."""
    geometry = geom_pad.any(dim=1)
    images = torch.stack(list(img_masks)).any(dim=0) if img_masks else torch.zeros_like(geometry)
    return torch.stack([geometry, images], dim=1)


def _one_camera(which: Tensor, cameras: Cameras, images: Tensor, geometry: Tensor) -> tuple[Tensor, Tensor]:
    """What is lost with one camera of those that a sample has, if it has two or more.

    which: (B,) in [0, 1), chooses. images (B, I), geometry (B, V): which cameras give something. Returns two like these.
    """
    names = list(dict.fromkeys([*cameras.images, *cameras.geometry]))
    gives_image = torch.zeros(len(which), len(names), dtype=torch.bool, device=which.device)
    gives_cells = gives_image.clone()
    at_image, at_cells = ([names.index(name) for name in found] for found in (cameras.images, cameras.geometry))
    gives_image[:, at_image] = images
    if geometry.shape[1]:
        gives_cells[:, at_cells] = geometry
    there = gives_image | gives_cells  # (B, N)
    count = there.sum(dim=1, keepdim=True)
    chosen = (which[:, None] * count).long().clamp(max=count - 1)  # the how manieth of those that are there
    lost = there & (there.cumsum(dim=1) - 1 == chosen) & (count > 1)
    lost_cells = lost[:, at_cells]
    if cameras.across_views:
        lost_cells = lost_cells.any(dim=1, keepdim=True).expand_as(lost_cells)
    return lost[:, at_image], lost_cells
