"""Whether geometry is taken up, and whether the policy learns to do without: what LeRobot's training log shows of it.

`gate_openness_pct` is the mean openness of the gate, `geometry_attention_pct` the share of the actions' attention, and
`geometry_update_pct` how far a step moves the new parameters, in percent. `loss_without_geometry` and `loss_without_images` are
running means of the loss of the samples from which modality dropout took one or the other. LeRobot logs three digits behind the
point.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor, nn

from ..model.paligemma_with_expert import PaliGemmaWithExpert
from .attention_share import AttentionShare
from .parameter_groups import UpdateSize

WITHOUT = ("loss_without_geometry", "loss_without_images")
MEMORY = 0.95  # of the running means, from one batch that has such samples to the next
SHARE_EVERY = 20  # training steps between two measurements of attention


class GeometryLog:
    """Numbers of the latest training step. geometry_tokens: of the segment, 0 without one."""

    def __init__(self, network: PaliGemmaWithExpert, geometry_tokens: int) -> None:
        self.update_size = UpdateSize()
        self._network, self._tokens = network, geometry_tokens
        self._share: Tensor | None = None
        self._without: Tensor | None = None  # (2,), NaN before the first sample

    @contextmanager
    def measuring(self, step: int) -> Iterator[None]:
        """Measure attention in a forward pass of this training step, if its turn has come."""
        if self._network.geometry_gate is None or not self._tokens or step % SHARE_EVERY:
            yield
            return
        share = AttentionShare(self._network, self._tokens)
        with share.measuring():
            yield
        self._share = share.mean()

    def moved(self, parameters: Sequence[nn.Parameter]) -> None:
        """Measure how far a step has moved the new parameters."""
        self.update_size.measure(parameters)

    @torch.no_grad()
    def went_without(self, losses: Tensor, without: Tensor) -> None:
        """Follow the losses of samples from which something was taken.

        losses: (B,). without: (B, 2) bool, the samples without geometry and those without images. Over all processes of a
        distributed training: LeRobot averages what they log by its place in the log, so all must have the same entries.
        """
        total = torch.stack(
            [losses[:, None].masked_fill(~without, 0.0).sum(dim=0), without.sum(dim=0).to(losses.dtype)]
        )
        if dist.is_available() and dist.is_initialized():
            dist.all_reduce(total)
        mean, count = total[0] / total[1].clamp_min(1), total[1]
        before = torch.full_like(mean, math.nan) if self._without is None else self._without.to(mean.device)
        running = torch.where(before.isnan(), mean, MEMORY * before + (1 - MEMORY) * mean)
        self._without = torch.where(count > 0, running, before)

    def numbers(self) -> dict[str, float]:
        """What is known, by its name in the log."""
        found = self.update_size.to_log()
        if self._network.geometry_gate is not None:
            found["gate_openness_pct"] = self._network.geometry_gate.mean_openness()
        if self._share is not None:
            found["geometry_attention_pct"] = self._share
        percent = {name: 100 * value.item() for name, value in found.items()}
        losses = zip(WITHOUT, [] if self._without is None else self._without.tolist(), strict=False)
        return percent | {name: loss for name, loss in losses if not math.isnan(loss)}
