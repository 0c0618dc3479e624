"""Source and adapter together, and what to do when a camera that geometry needs fails.

In training, a missing camera or a frame of NaN is an error: the data is wrong. On a robot it is weather: once geometry has
been seen, a camera that goes silent (its key is missing, or no pixel is valid) is masked, said once, and used again when
it returns. A robot that never had its key is misconfigured, which is an error again. On a GPU this is said one observation
later, so that no chunk waits for it.
"""

import logging
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..model.precision import compute_in_float32
from ..model.segments import GeometryTokens
from .adapter import GeometryAdapter
from .keys import batch_like
from .source import GeometryFeatures, GeometrySource

logger = logging.getLogger(__name__)


class _Look(NamedTuple):
    """Which cameras gave something, (V,) bool, on its way to the host if a GPU has it; and which were not there at all.

    It is read with the next observation, when it has long arrived: to wait for it would be to wait for the GPU.
    """

    alive: Tensor
    arrived: torch.cuda.Event | None
    missing: set[str]

    @classmethod
    def at(cls, alive: Tensor, missing: set[str]) -> "_Look":
        if alive.device.type != "cuda":
            return cls(alive, None, missing)
        arrived = torch.cuda.Event()
        copy = alive.to("cpu", non_blocking=True)  # into pinned memory
        arrived.record(torch.cuda.current_stream(alive.device))
        return cls(copy, arrived, missing)

    @property
    def on_its_way(self) -> bool:
        return self.arrived is not None

    def read(self) -> list[bool]:
        if self.arrived is not None:
            self.arrived.synchronize()
        return self.alive.tolist()


class GeometryEncoder(nn.Module):
    """Observation batch -> tokens (B, V * G, W) float32 and padding mask (B, V * G)."""

    def __init__(self, source: GeometrySource, width: int) -> None:
        super().__init__()
        self.source = source
        self.adapter = GeometryAdapter(source.feature_dim, width, source.grid, len(source.cameras))
        self._seen: set[str] = set()
        self._failed: set[str] = set()
        self._checked = False
        self._unread: _Look | None = None

    def reset(self) -> None:
        """Start of an episode: look into the values of the next observation again."""
        self._take_note()
        self._checked = False

    def forward(self, batch: Mapping[str, Tensor]) -> GeometryTokens:
        # A caller's autocast would place points to within millimetres only, and training's is not inference's.
        with compute_in_float32(batch_like(batch).device):
            return self.adapter(self._measured(batch) if self.training else self._live(batch))

    def _measured(self, batch: Mapping[str, Tensor]) -> GeometryFeatures:
        """Features of a training batch, where every camera must be there, but for optional ones."""
        missing = [camera for camera in self.source.missing_cameras(batch) if camera not in self.source.optional]
        if missing:
            raise ValueError(self.source.missing_message(missing))
        return self.source(batch, check=True)

    def _live(self, batch: Mapping[str, Tensor]) -> GeometryFeatures:
        """Features at inference: a camera that fails is masked, once it has been seen."""
        self._take_note()
        missing = self.source.missing_cameras(batch)
        unknown = [camera for camera in missing if camera not in self._seen | self.source.optional]
        if unknown:
            raise ValueError(self.source.missing_message(unknown))
        if len(missing) == len(self.source.cameras):
            self._report(set(missing))
            return self._nothing(batch)
        geometry = self.source(batch, check=not self._checked)
        self._unread = _Look.at(geometry.valid.any(dim=-1).any(dim=0), set(missing))
        if not self._unread.on_its_way:
            self._take_note()
        return geometry

    def _take_note(self) -> None:
        """Of which cameras gave something in the last observation."""
        look, self._unread = self._unread, None
        if look is None:
            return
        alive = {camera for camera, ok in zip(self.source.cameras, look.read(), strict=True) if ok}
        self._checked = self._checked or bool(alive)
        self._seen |= alive - look.missing
        self._report(set(self.source.cameras) - alive)

    def _nothing(self, batch: Mapping[str, Tensor]) -> GeometryFeatures:
        """Features of an observation without any geometry: all masked."""
        like = batch_like(batch)
        shape = (like.shape[0], len(self.source.cameras), self.source.grid**2)
        return GeometryFeatures(
            torch.zeros(*shape, self.source.feature_dim, device=like.device),
            torch.zeros(shape, dtype=torch.bool, device=like.device),
        )

    def _report(self, failed: set[str]) -> None:
        """Say once that a camera failed, and once that it is back."""
        for camera in sorted(failed - self._failed):
            logger.warning("Geometry camera '%s' gives nothing: its geometry is masked until it returns.", camera)
        for camera in sorted(self._failed - failed):
            logger.info("Geometry camera '%s' is back.", camera)
        self._failed = failed
