"""The interface of a geometry source: observation batch -> features per cell."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

from torch import Tensor, nn


class GeometryFeatures(NamedTuple):
    """Geometry of a batch of observations.

    features: (B, V, G, C) float32, zeros where not valid. valid: (B, V, G) bool, False for a cell with no measurement
    and for every cell of an absent camera. G is row-major over the grid, top-left cell first.
    """

    features: Tensor
    valid: Tensor


class GeometrySource(nn.Module, ABC):
    """Turns an observation batch into per-cell features.

    cameras: names of the V cameras in token order. grid: cells per side. feature_dim: C. optional: cameras that any
    observation may lack; another one that is missing is an error in training, and a failed camera at inference. across_views:
    whether features of one camera's cells depend on the other cameras. points: number of points that a cell's features hold,
    each as x, y, z and 1, or 0 for one that was not measured, in any order; 0: the features are one vector.
    """

    cameras: tuple[str, ...]
    grid: int
    feature_dim: int
    optional: frozenset[str] = frozenset()
    across_views: bool = False
    points: int = 0

    @property
    def num_tokens(self) -> int:
        """V * G, the length of the geometry segment."""
        return len(self.cameras) * self.grid**2

    @abstractmethod
    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        """Cameras that have no data in this batch."""

    def may_lack(self, camera: str, batch: Mapping[str, Tensor]) -> bool:
        """Whether this observation may lack this camera, which `missing_cameras` names."""
        return camera in self.optional

    def missing_message(self, cameras: list[str]) -> str:
        """One sentence on what was expected from these cameras and what to do."""
        return f"The observation has nothing from camera(s) {', '.join(cameras)}, which geometry needs; connect them."

    @abstractmethod
    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        """Features of a batch; a missing camera's cells are invalid.

        batch: raw observation tensors under LeRobot's keys. check: check values (units, poses) too, which copies to the
        host; shapes and dtypes are always checked.
        """
