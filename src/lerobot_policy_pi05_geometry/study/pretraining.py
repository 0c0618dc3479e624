"""The π0.5 that a warm-start study begins with: trained on RGB over several tasks, and exported to LeRobot's layout."""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ..checkpoint.conversion import export
from ..checkpoint.load import load_policy
from ..sim.evaluate import Evaluation, evaluate
from .arms import ARMS
from .recordings import Recording, merge_recordings
from .runs import ReportProgress, Run, option_list, short_hash, versions
from .simulated_tasks import SimulatedTask, simulated_task
from .spec import Budget, Pretraining
from .training import train_with
from .training_options import dataset_options, network_options, training_options

EVALUATION = ("evaluation_episodes", "parallel", "videos")  # fields of the budget that training does not depend on
NOT_PRETRAINING = ("episodes", "steps", "learning_rate", "adaptation_steps")  # fields that pretraining has of its own


@dataclass(frozen=True)
class PretrainingRun(Run):
    """Training of plain π0.5 on RGB. Its conditions are tasks, each with the camera range of its training."""

    pretraining: Pretraining
    budget: Budget

    @property
    def name(self) -> str:
        return f"pretraining-{self.seed}"

    @property
    def steps(self) -> int:
        return self.pretraining.steps

    @property
    def evaluation_size(self) -> int:
        return self.budget.evaluation_episodes

    @cached_property
    def recordings(self) -> list[Recording]:
        about = self.pretraining
        return [
            Recording(self.root, task, about.cameras, about.episodes, self.budget.image_size) for task in about.tasks
        ]

    @property
    def simulated(self) -> SimulatedTask:
        """Its first task; the others have the same cameras and sizes."""
        return simulated_task(self.pretraining.tasks[0])

    def data_description(self) -> dict[str, Any]:
        """Everything that the training data depends on."""
        return {"recordings": [recording.description() for recording in self.recordings]}

    @property
    def data_folder(self) -> Path:
        return self.root / "data" / f"pretraining-{short_hash(self.data_description())}"

    @property
    def pi05(self) -> Path:
        """The trained policy as a π0.5 checkpoint of LeRobot, from which every arm is converted."""
        return self.folder / "trained" / "pi05"

    def description(self) -> dict[str, Any]:
        left_out = (*EVALUATION, *NOT_PRETRAINING)
        budget = {name: value for name, value in asdict(self.budget).items() if name not in left_out}
        return {
            "pretraining": {name: v for name, v in asdict(self.pretraining).items() if name != "evaluated"},
            "budget": budget,
            "data": self.data_description(),
            "versions": versions(*self.simulated.packages),
        }

    def evaluation_description(self, condition: str) -> dict[str, Any]:
        return {
            "cameras": self.simulated.camera_description(self.pretraining.cameras),
            "budget": {name: getattr(self.budget, name) for name in EVALUATION},
        }

    def distinct_conditions(self) -> list[str]:
        return list(self.conditions)

    def prepare(self, report_progress: ReportProgress) -> None:
        for recording in self.recordings:
            recording.make(report_progress)
        merge_recordings(self.recordings, self.data_folder, "local/pretraining")

    def train(self, output: Path) -> None:
        train_with(self.arguments(output))
        export(output / "checkpoints" / "last" / "pretrained_model", output / "pi05")

    def arguments(self, output: Path) -> list[str]:
        """lerobot-train's arguments."""
        about = self.pretraining
        return option_list(
            {
                **network_options(self.budget, self.simulated.action_dim),
                **training_options(self.budget, about.steps, about.learning_rate, about.seed, self.log_every),
                **ARMS["rgb"].options,
                **dataset_options(self.data_folder, "local/pretraining", output),
            }
        )

    def evaluation(self, condition: str) -> Evaluation | None:
        """The episodes of one of its tasks; None before evaluation."""
        path = self.outcome(condition)
        return Evaluation.load(path) if path.exists() else None

    def evaluate(self, condition: str, report_progress: ReportProgress) -> None:
        budget = self.budget
        environment = simulated_task(condition).environment(self.pretraining.cameras, budget.image_size)
        evaluate(
            load_policy(self.checkpoint, budget.device, environment),
            environment,
            budget.evaluation_episodes,
            parallel=budget.parallel,
            progress=lambda done: report_progress(f"evaluate {condition}", done, budget.evaluation_episodes),
        ).save(self.outcome(condition))


def pretraining_run(root: Path, pretraining: Pretraining, budget: Budget) -> PretrainingRun:
    """The run of a study's [pretrain] table."""
    return PretrainingRun(root.absolute(), "rgb", pretraining.seed, pretraining.evaluated, pretraining, budget)


def read_pretraining(content: dict[str, Any]) -> Pretraining:
    """A `Pretraining` from JSON, which has lists for tuples."""
    values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in content.items()}
    return Pretraining(**values)


def from_json(content: dict[str, Any]) -> PretrainingRun:
    """The run that `to_json` wrote."""
    return PretrainingRun(
        Path(content["root"]),
        content["arm_name"],
        content["seed"],
        tuple(content["conditions"]),
        read_pretraining(content["pretraining"]),
        Budget(**content["budget"]),
    )
