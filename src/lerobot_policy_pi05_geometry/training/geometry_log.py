"""Whether geometry is taken up: what LeRobot's training log shows of it, in percent.

`gate_openness_pct` is the mean openness of the gate, `geometry_attention_pct` the share of the actions' attention, and
`geometry_update_pct` how far a step moves the new parameters. LeRobot logs three digits behind the point.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from torch import Tensor, nn

from ..model.paligemma_with_expert import PaliGemmaWithExpert
from .attention_share import AttentionShare
from .parameter_groups import UpdateSize

SHARE_EVERY = 20  # training steps between two measurements of attention


class GeometryLog:
    """Numbers of the latest training step. geometry_tokens: of the segment, 0 without one."""

    def __init__(self, network: PaliGemmaWithExpert, geometry_tokens: int) -> None:
        self.update_size = UpdateSize()
        self._network, self._tokens = network, geometry_tokens
        self._share: Tensor | None = None

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

    def numbers(self) -> dict[str, float]:
        """What is known, by its name in the log."""
        found = self.update_size.to_log()
        if self._network.geometry_gate is not None:
            found["gate_openness_pct"] = self._network.geometry_gate.mean_openness()
        if self._share is not None:
            found["geometry_attention_pct"] = self._share
        return {name: 100 * value.item() for name, value in found.items()}
