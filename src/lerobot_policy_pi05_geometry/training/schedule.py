"""LeRobot's cosine schedule for this policy, which knows whether the geometry gate can open within a run, and whether it has.

LeRobot fits the schedule to `--steps`, and Adam moves a parameter by at most about its rate each step. So rate times schedule,
summed up, bounds how far the gate can get: too short a run trains a policy without geometry, and no number in its log says so.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.optim import LRSchedulerConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig
from torch import Tensor
from torch.optim import SGD, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from .parameter_groups import GATE_GROUP, NAME

logger = logging.getLogger(__name__)

OPEN = 1.0  # mean openness that a run should be able to reach
SHUT = 0.02  # mean openness below which a policy acts as if it had no geometry
ADVICE = "`pi05-geometry convert` writes geometry_gate_lr=0.05, geometry_lr=0.003 and image_dropout=0.4"


@LRSchedulerConfig.register_subclass("pi05_geometry_cosine")
@dataclass
class GateAwareScheduleConfig(CosineDecayWithWarmupSchedulerConfig):
    """LeRobot's cosine decay with warm-up, number for number. It warns of a gate that cannot open, and of one that did not."""

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        unit = SGD([torch.zeros(1)], lr=1.0)  # LeRobot makes the factor on the rates and the schedule in one go
        factor: Callable[[int], float] = super().build(unit, num_training_steps).lr_lambdas[0]
        schedule = GateAwareSchedule(optimizer, factor, num_training_steps)
        schedule.warn_if_out_of_reach()
        return schedule


class GateAwareSchedule(LambdaLR):
    """`LambdaLR` that looks at the gate before the first step and after the last of `steps`."""

    def __init__(self, optimizer: Optimizer, factor: Callable[[int], float], steps: int) -> None:
        self._factor, self._steps = factor, steps
        super().__init__(optimizer, factor)

    def state_dict(self) -> dict[str, Any]:
        """As `LambdaLR`'s: a resumed run may have other steps."""
        return {name: value for name, value in super().state_dict().items() if name not in ("_factor", "_steps")}

    def _gate(self) -> dict[str, Any] | None:
        """The gate's parameter group."""
        found = (group for group in self.optimizer.param_groups if group.get(NAME) == GATE_GROUP)
        return next(found, None)

    def warn_if_out_of_reach(self) -> None:
        """Warn of a run in which the gate cannot open even if every step of Adam had the same sign."""
        group = self._gate()
        if group is None:
            return
        start = _mean_openness(group["params"])
        travel = sum(map(self._factor, range(self._steps)))  # steps at the full rate
        reach = start + group["initial_lr"] * travel
        if reach < OPEN:
            logger.warning(
                "The geometry gate cannot open in this run, whose policy will act almost as if it had no geometry: from an "
                "openness of %.2g it can reach %.2g at most, with geometry_gate_lr=%g over %d steps (%.0f at the full rate, as "
                "LeRobot fits the schedule to --steps); train longer, or raise it to %.1g (%s).",
                start, reach, group["initial_lr"], self._steps, travel, 10 * OPEN / max(travel, 1e-9), ADVICE,
            )  # fmt: skip

    def step(self, epoch: int | None = None) -> None:
        super().step(epoch)
        group = self._gate()
        if group is None or self.last_epoch != self._steps:
            return
        openness = _mean_openness(group["params"])
        if openness < SHUT:
            logger.warning(
                "The geometry gate has stayed shut (mean openness %.2g after %d steps), so this policy acts almost as if it had "
                "no geometry; train longer, or with other rates (%s).", openness, self._steps, ADVICE,
            )  # fmt: skip
        else:
            logger.info("Mean openness of the geometry gate after %d steps: %.2g.", self._steps, openness)


@torch.no_grad()
def _mean_openness(parameters: Sequence[Tensor]) -> float:
    return torch.cat([parameter.flatten() for parameter in parameters]).abs().mean().item()
