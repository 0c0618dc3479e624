"""The store as a geometry source. Frames of the dataset are read; other observations go through the encoder."""

from collections.abc import Callable, Mapping, Set

import torch
from torch import Tensor

from ..source import GeometryFeatures, GeometrySource
from .reader import FeatureStore

_INDEX = "index"  # LeRobot's name for a frame's place in the dataset


class FeatureStoreSource(GeometrySource):
    """Features of a dataset's frames by their `index`. They are what `live` would compute, rounded to bfloat16.

    live: makes the source that the store was computed with; called when, outside of training, an observation has no index
    (an environment that lerobot-train evaluates in). optional: cameras that observations may lack.
    """

    across_views = True

    def __init__(
        self, store: FeatureStore, live: Callable[[], GeometrySource], optional: Set[str] = frozenset()
    ) -> None:
        super().__init__()
        self.cameras, self.grid = tuple(store.manifest.cameras), store.manifest.grid
        self.feature_dim, self.optional = store.manifest.feature_dim, frozenset(optional)
        self.store = store
        self._make_live, self._live = live, ()  # type: tuple[Callable[[], GeometrySource], tuple[GeometrySource, ...]]

    def missing_cameras(self, batch: Mapping[str, Tensor]) -> list[str]:
        return self._find_live().missing_cameras(batch) if self._is_live(batch) else []

    def missing_message(self, cameras: list[str]) -> str:
        return self._find_live().missing_message(cameras)

    def forward(self, batch: Mapping[str, Tensor], check: bool = True) -> GeometryFeatures:
        """See `GeometrySource.forward`. Raises ValueError for a training batch without index, or a frame not in the store."""
        if self._is_live(batch):
            return self._find_live()(batch, check)
        if _INDEX not in batch:
            raise ValueError(
                "A training batch has no 'index', by which the feature store finds its frames; train on a LeRobotDataset, or "
                "with --policy.geometry_source=da3."
            )
        index = batch[_INDEX]
        features = self.store.read([int(i) for i in index.flatten().tolist()], pin=index.is_cuda)
        features = features.to(index.device, non_blocking=True).float()
        return GeometryFeatures(features, torch.ones(features.shape[:3], dtype=torch.bool, device=index.device))

    def _is_live(self, batch: Mapping[str, Tensor]) -> bool:
        return not self.training and _INDEX not in batch

    def _find_live(self) -> GeometrySource:
        if not self._live:
            self._live = (self._make_live(),)  # in a tuple, so that it is no submodule
        return self._live[0]
