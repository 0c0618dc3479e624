"""An arm that is not trained but adapted: the policy of another arm, and one demonstration under each condition."""

from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig

from ..checkpoint.load import LoadedPolicy
from .conditions import find_condition
from .modulation import LEARNING_RATE, adapt
from .recordings import Recording
from .runs import ReportProgress
from .simulated import SimulatedRun, run_arguments


class AdaptedRun(SimulatedRun):
    """One-shot feature modulation (modulation.py) of another arm's policy.

    The demonstration is one expert episode with a camera of the condition's range. A condition at one azimuth is the paper's
    setting: adapted to the viewpoint that is evaluated. In a wider range the demonstration has another pose than most episodes.
    """

    @cached_property
    def base(self) -> SimulatedRun:
        """The run whose policy is adapted."""
        assert self.arm.adapts is not None
        return SimulatedRun(
            self.root, self.arm.adapts, self.seed, (), self.task, self.budget, self.pretraining, self.multiple
        )

    @property
    def checkpoint(self) -> Path:
        return self.base.checkpoint

    def demonstration(self, condition: str) -> Recording:
        """One expert episode under the condition's cameras; no episode of the training or evaluation data."""
        cameras = find_condition(condition).cameras
        return Recording(self.root, self.task, cameras, 1, self.budget.image_size, seed=1 + self.seed)

    def description(self) -> dict[str, Any]:
        content = {"adapted": self.base.description(), "rate": LEARNING_RATE, "noise": self.seed}
        return {**content, **asdict(self.budget)}

    def evaluation_description(self, condition: str) -> dict[str, Any]:
        demonstration = self.demonstration(condition).description()
        return {**super().evaluation_description(condition), "demonstration": demonstration}

    def prepare(self, report_progress: ReportProgress) -> None:
        if not self.checkpoint.exists():
            raise FileNotFoundError(f"Run {self.name} adapts run {self.base.name}, which has not been trained.")
        for condition in self.distinct_conditions():
            self.demonstration(condition).make(report_progress)

    def load(self, condition: str, environment: EnvConfig) -> LoadedPolicy:
        torch.manual_seed(self.seed)  # a policy takes the seed of its training noise when it is built
        loaded = super().load(condition, environment)
        demonstration, config = self.demonstration(condition), loaded.policy.config
        dataset = LeRobotDataset(
            demonstration.repo_id,
            root=demonstration.folder,
            delta_timestamps={"action": [step / environment.fps for step in range(config.chunk_size)]},
            depth_output_unit=config.depth_unit,
        )
        adapt(loaded, dataset, self.budget.adaptation_steps, self.budget.batch_size, self.seed)
        return loaded


def from_json(content: dict[str, Any]) -> AdaptedRun:
    """The run that `to_json` wrote."""
    return AdaptedRun(**run_arguments(content))
