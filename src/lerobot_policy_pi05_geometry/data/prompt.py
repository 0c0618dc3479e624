"""The prompt of π0.5: the task and the discretised state, as text."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from .training_batch import sample_name

STATE_BINS = 256
NO_TASK = "Task: "  # how every prompt begins
_STATE = ", State: "


@ProcessorStepRegistry.register(name="pi05_geometry_prompt")
@dataclass
class PromptProcessorStep(ProcessorStep):
    """Writes "Task: ..., State: 12 200 ...;\\nAction: " into the task, from the normalised state.

    The state is clipped to [-1, 1] and put into bins 0..255, as openpi does. LeRobot does not clip, and writes "-1" for a
    state below the range.
    """

    task_key: str = "task"

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        state = (transition.get(TransitionKey.OBSERVATION) or {}).get(OBS_STATE)
        data = dict(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        tasks = data.get(self.task_key)
        if state is None:
            raise ValueError(f"The observation has no {OBS_STATE}, which the prompt is made from.")
        if tasks is None:
            raise ValueError("The observation has no task; say what the robot should do (LeRobot's `task`).")
        tasks = [tasks] if isinstance(tasks, str) else list(tasks)
        if len(tasks) == 1:  # one task for the whole batch
            tasks = tasks * len(state)
        if len(tasks) != len(state):
            raise ValueError(
                f"The batch has {len(state)} states but {len(tasks)} tasks; give one task, or one for each."
            )
        _require_finite(state, data)
        bins = discretise_state(state).tolist()
        data[self.task_key] = [make_prompt(task, row) for task, row in zip(tasks, bins, strict=True)]
        transition[TransitionKey.COMPLEMENTARY_DATA] = data
        return transition

    def get_config(self) -> dict[str, Any]:
        return {"task_key": self.task_key}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def _require_finite(state: Tensor, data: dict[str, Any]) -> None:
    """Raise ValueError for NaN or inf in the state (B, D). data: the complementary data, for the dataset index."""
    if not state.isfinite().all():
        row, dim = (~state.isfinite()).nonzero()[0].tolist()
        raise ValueError(
            f"{OBS_STATE}[{dim}] is {state[row, dim].item()} in {sample_name(data, row)}. Repair the sensor, or correct that "
            "frame or leave out its episode (`lerobot-edit-dataset`)."
        )


def discretise_state(state: Tensor) -> Tensor:
    """Normalised, finite state (B, D) -> bins 0..255, (B, D) int64."""
    edges = torch.linspace(-1.0, 1.0, STATE_BINS + 1, dtype=torch.float64)[:-1]
    return torch.bucketize(state.cpu().double().clamp(-1.0, 1.0), edges, right=True) - 1


def make_prompt(task: str, bins: list[int]) -> str:
    """π0.5's prompt for one observation."""
    text = task.strip().replace("_", " ").replace("\n", " ")
    return f"{NO_TASK}{text}{_STATE}{' '.join(map(str, bins))};\nAction: "


def split_prompt(prompt: str) -> tuple[str, str]:
    """A prompt as its task ("Task: ...") and the rest, from the state on; no task if it is another text."""
    task, state, rest = prompt.rpartition(_STATE)
    return task, state + rest
