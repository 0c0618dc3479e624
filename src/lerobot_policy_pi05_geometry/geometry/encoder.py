"""Source and adapter together, and the handling of a camera that fails.

In training, a missing camera or a frame of NaN is an error of the data. On a robot, a camera that has delivered geometry may
fail: its key is missing, or no pixel is valid. Its tokens are then masked, and used again when it returns; both are logged once,
and once more that it fails again: a server computes one robot after the other, and would log a failed camera with every request.
A robot that does not deliver the key in the first observation of an episode is configured wrongly, which is an error. All of this
belongs to one episode and to one row of a batch: what one robot's camera did says nothing about another's. On a GPU a failure is
logged one observation later, so that no chunk waits for the copy to the host.
"""

import logging
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..model.precision import compute_in_float32
from ..model.segments import GeometryTokens
from .adapter import make_adapter
from .keys import batch_like
from .source import GeometryFeatures, GeometrySource

logger = logging.getLogger(__name__)

# In training, values (units, poses) are checked in the first batches of a run, and then in one batch of so many. Each check
# copies a result to the host, which a GPU would wait for in every step. On a CPU every batch is checked.
FIRST_CHECKED = 16
CHECKED_EVERY = 64


class _CameraStatus(NamedTuple):
    """Which cameras have a valid cell, (B, V) bool, being copied to the host if it is on a GPU; and which were absent.

    It is read with the next observation, when the copy has finished. Reading it at once would wait for the GPU.
    """

    alive: Tensor
    arrived: torch.cuda.Event | None
    missing: set[str]

    @classmethod
    def of(cls, alive: Tensor, missing: set[str]) -> "_CameraStatus":
        if alive.device.type != "cuda":
            return cls(alive, None, missing)
        arrived = torch.cuda.Event()
        copy = alive.to("cpu", non_blocking=True)  # into pinned memory
        arrived.record(torch.cuda.current_stream(alive.device))
        return cls(copy, arrived, missing)

    @property
    def pending(self) -> bool:
        return self.arrived is not None

    def read(self) -> list[list[bool]]:
        if self.arrived is not None:
            self.arrived.synchronize()
        rows: list[list[bool]] = self.alive.tolist()
        return rows


class GeometryEncoder(nn.Module):
    """Observation batch -> tokens (B, V * G, W) float32 and padding mask (B, V * G)."""

    def __init__(self, source: GeometrySource, width: int) -> None:
        super().__init__()
        self.source = source
        self.adapter = make_adapter(source, width)
        self._seen: set[str] = set()
        self._failed: set[tuple[int, str]] = set()  # rows and cameras
        self._failures: Counter[tuple[int, str]] = Counter()  # how often in this episode
        self._checked: set[int] = set()  # rows
        self._unread: _CameraStatus | None = None
        self._training_batches = 0

    def reset(self) -> None:
        """Start of an episode, maybe of another robot: no camera has been seen, and none has failed."""
        self._update_status()
        self._seen, self._failed, self._checked = set(), set(), set()
        self._failures.clear()

    def forward(self, batch: Mapping[str, Tensor]) -> GeometryTokens:
        # A caller's autocast would round points to millimetres, and training has another autocast than inference.
        with compute_in_float32(batch_like(batch).device):
            return self.adapter(self._measured(batch) if self.training else self._live(batch))

    def _measured(self, batch: Mapping[str, Tensor]) -> GeometryFeatures:
        """Features of a training batch, where every camera that is not optional must be present."""
        missing = [name for name in self.source.missing_cameras(batch) if not self.source.may_lack(name, batch)]
        if missing:
            raise ValueError(self.source.missing_message(missing))
        check = batch_like(batch).device.type == "cpu" or self._check_is_due()
        self._training_batches += 1
        return self.source(batch, check=check)

    def _check_is_due(self) -> bool:
        return self._training_batches < FIRST_CHECKED or self._training_batches % CHECKED_EVERY == 0

    def _live(self, batch: Mapping[str, Tensor]) -> GeometryFeatures:
        """Features at inference: a camera that fails is masked, once it has been seen."""
        self._update_status()
        missing = self.source.missing_cameras(batch)
        unknown = [name for name in missing if name not in self._seen and not self.source.may_lack(name, batch)]
        if unknown:
            raise ValueError(self.source.missing_message(unknown))
        rows = range(batch_like(batch).shape[0])
        if len(missing) == len(self.source.cameras):
            self._report({(row, camera) for row in rows for camera in missing}, len(rows))
            return self._nothing(batch)
        geometry = self.source(batch, check=not self._checked.issuperset(rows))
        self._unread = _CameraStatus.of(geometry.valid.any(dim=-1), set(missing))
        if not self._unread.pending:
            self._update_status()
        return geometry

    def _update_status(self) -> None:
        """Take over which cameras delivered geometry in the last observation."""
        status, self._unread = self._unread, None
        if status is None:
            return
        failed, rows = set(), status.read()
        for row, alive in enumerate(rows):
            if any(alive):
                self._checked.add(row)
            for camera, delivers in zip(self.source.cameras, alive, strict=True):
                if not delivers:
                    failed.add((row, camera))
                elif camera not in status.missing:
                    self._seen.add(camera)
        self._report(failed, len(rows))

    def _nothing(self, batch: Mapping[str, Tensor]) -> GeometryFeatures:
        """Features of an observation without any geometry: all masked."""
        like = batch_like(batch)
        shape = (like.shape[0], len(self.source.cameras), self.source.grid**2)
        return GeometryFeatures(
            torch.zeros(*shape, self.source.feature_dim, device=like.device),
            torch.zeros(shape, dtype=torch.bool, device=like.device),
        )

    def _report(self, failed: set[tuple[int, str]], size: int) -> None:
        """Log once that a camera failed, once that it is back, and once that it fails again. size: rows of the batch.

        An optional camera that the episode has not seen may stay away without a word.
        """
        expected = self._seen | (set(self.source.cameras) - self.source.optional)
        self._failures.update((row, name) for row, name in failed - self._failed if name in expected)

        def log(level: int, message: str, changed: set[tuple[int, str]], failures: int) -> None:
            for camera in self.source.cameras:
                rows = [
                    row for row, name in sorted(changed) if name == camera and self._failures[row, name] == failures
                ]
                if rows and camera in expected:
                    logger.log(level, message, camera, _rows(rows, size))

        gone, masked = failed - self._failed, "its tokens are masked until it returns"
        log(logging.WARNING, f"Geometry camera '%s' delivers no geometry%s: {masked}.", gone, 1)
        log(
            logging.WARNING,
            f"Geometry camera '%s' fails again%s: {masked}, and this episode reports it no more.",
            gone,
            2,
        )
        log(logging.INFO, "Geometry camera '%s' is back%s.", self._failed - failed, 1)
        self._failed = failed


def _rows(rows: list[int], size: int) -> str:
    return "" if len(rows) == size else f" in row {', '.join(map(str, rows))} of the batch"
