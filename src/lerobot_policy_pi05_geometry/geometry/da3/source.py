"""Geometry from RGB cameras: Depth Anything 3's features, one pass over all cameras of a sample, pooled to cells."""

from collections.abc import Mapping, Set

import torch
from torch import Tensor

from ..images import rgb_image
from ..keys import batch_like
from ..source import GeometryFeatures, GeometrySource
from .encoder import Da3Encoder, resize
from .variants import PATCH

_SMALLEST = 196  # pixels; a smaller image has too few patches


def default_image_size(grid: int) -> int:
    """Pixels per side: the smallest size from 196 on that a grid divides into whole patches. 8 -> 224, 14 -> 196."""
    step = PATCH * grid
    return -(-_SMALLEST // step) * step


class Da3Source(GeometrySource):
    """Features of a frozen any-view encoder; cameras are resized to a square and attend to each other.

    keys: camera name -> key of its images, in token order; the first camera that is present is the reference view.
    image_size: pixels per side, a multiple of 14 * grid. optional: cameras that observations may lack.
    """

    across_views = True

    def __init__(
        self,
        keys: Mapping[str, str],
        grid: int,
        encoder: Da3Encoder,
        image_size: int | None = None,
        optional: Set[str] = frozenset(),
    ) -> None:
        super().__init__()
        self.cameras, self.grid, self.keys = tuple(keys), grid, dict(keys)
        self.optional = frozenset(optional)
        self.feature_dim = encoder.variant.feature_dim
        self.image_size = default_image_size(grid) if image_size is None else image_size
        if self.image_size < 1 or self.image_size % (PATCH * grid):
            raise ValueError(
                f"da3_image_size must be a multiple of {PATCH * grid} pixels, so that a grid of {grid} holds whole patches of "
                f"{PATCH}, got {self.image_size}."
            )
        # In a tuple, so that it is no submodule: checkpoint, optimiser, train() and DDP do not see its weights.
        self._frozen = (encoder,)

    @property
    def encoder(self) -> Da3Encoder:
        return self._frozen[0]

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return [camera for camera in self.cameras if self.keys[camera] not in batch]

    def missing_message(self, cameras: list[str]) -> str:
        return (
            f"The observation has no images from camera(s) {', '.join(cameras)}: expected "
            f"{', '.join(self.keys[camera] for camera in cameras)}; connect the camera, rename its key with --rename_map, or "
            "train with --policy.geometry_source=none."
        )

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        """See `GeometrySource.forward`. Values of images are not checked, so nothing is copied to the host."""
        present = [i for i, camera in enumerate(self.cameras) if self.keys[camera] in batch]
        like = batch_like(batch)
        shape = (like.shape[0], len(self.cameras), self.grid**2)
        features = torch.zeros(*shape, self.feature_dim, device=like.device)
        valid = torch.zeros(shape, dtype=torch.bool, device=like.device)
        if present:
            images = torch.stack([self._image(self.cameras[i], batch) for i in present], dim=1)
            if self.encoder.mean.device != images.device:  # it is no submodule, so `policy.to` does not move it
                self.encoder.to(images.device)
            pooled = pool(self.encoder(images), self.grid)
            for view, i in enumerate(present):
                features[:, i] = pooled[:, view]
                valid[:, i] = True
        return GeometryFeatures(features, valid)

    def _image(self, camera: str, batch: Mapping[str, Tensor]) -> Tensor:
        """(B, 3, S, S) float32 in [0, 1]."""
        key = self.keys[camera]
        return resize(rgb_image(batch[key], key), self.image_size)


def pool(features: Tensor, grid: int) -> Tensor:
    """Mean over the patches of each cell: (B, V, h, w, F) -> (B, V, grid², F); grid divides h and w."""
    cells = features.unflatten(3, (grid, -1)).unflatten(2, (grid, -1))  # (B, V, grid, h/grid, grid, w/grid, F)
    return cells.mean(dim=(3, 5)).flatten(2, 3)
