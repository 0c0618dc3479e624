"""A run in the simulator: the same expert episodes for every arm, success on the same evaluation seeds."""

import itertools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..checkpoint.load import load_policy
from ..sim.cameras import CAMERA_RANGES
from ..sim.configuration import MetaworldRgbdEnv
from ..sim.evaluate import Evaluation, evaluate
from ..sim.record import record
from ..sim.sensor import SENSORS
from ..sim.tasks import find_task
from .conditions import equivalent_condition, find_condition
from .locks import folder_lock
from .runs import ReportProgress, Run, option_list, short_hash, versions
from .spec import Budget, StudySpec
from .training import train_with

_EVALUATION = ("evaluation_episodes", "parallel", "videos")  # fields of the budget that training does not depend on
_PACKAGES = ("lerobot_policy_pi05_geometry", "lerobot", "torch", "mujoco", "metaworld")


@dataclass(frozen=True)
class SimulatedRun(Run):
    """A task, an arm and a training seed. Its dataset is <root>/data/<task>-<cameras>-<hash>/."""

    task: str
    budget: Budget

    @property
    def name(self) -> str:
        return f"{self.task}-{self.arm_name}-{self.seed}"

    @property
    def steps(self) -> int:
        return self.budget.steps

    @property
    def evaluation_size(self) -> int:
        return self.budget.evaluation_episodes

    def data_description(self) -> dict[str, Any]:
        """Everything that the expert episodes depend on."""
        return {
            "task": asdict(find_task(self.task)),
            "cameras": asdict(CAMERA_RANGES[self.arm.cameras]),
            "episodes": self.budget.episodes,
            "image_size": self.budget.image_size,
            "versions": versions(*_PACKAGES),
        }

    def description(self) -> dict[str, Any]:
        spent = {name: value for name, value in asdict(self.budget).items() if name not in _EVALUATION}
        arm = {"arm": self.arm_name, "options": self.arm.options, "seed": self.seed}
        return {**arm, "budget": spent, "data": self.data_description()}

    def evaluation_description(self, condition: str) -> dict[str, Any]:
        about = find_condition(condition)
        return {
            "cameras": asdict(CAMERA_RANGES[about.cameras]),
            "sensor": asdict(SENSORS[about.sensor]),
            "budget": {name: getattr(self.budget, name) for name in _EVALUATION},
        }

    @property
    def data_folder(self) -> Path:
        return self.root / "data" / f"{self.task}-{self.arm.cameras}-{short_hash(self.data_description())}"

    def distinct_conditions(self) -> list[str]:
        return list(dict.fromkeys(equivalent_condition(condition, self.arm.depth) for condition in self.conditions))

    def evaluation(self, condition: str) -> Evaluation | None:
        """The episodes of a condition; None before evaluation."""
        path = self.outcome(equivalent_condition(condition, self.arm.depth))
        return Evaluation.load(path) if path.exists() else None

    def prepare(self, report_progress: ReportProgress) -> None:
        budget, cameras = self.budget, self.arm.cameras
        with folder_lock(self.data_folder):
            if self.data_folder.exists():
                return
            repo_id = f"local/{self.task}"
            for done, _ in record(self.data_folder, repo_id, self.task, budget.episodes, cameras, budget.image_size):
                report_progress("record", done, budget.episodes)

    def train(self, output: Path) -> None:
        train_with(self.arguments(output))

    def arguments(self, output: Path) -> list[str]:
        """lerobot-train's arguments."""
        budget = self.budget
        options: dict[str, Any] = {
            "policy.type": "pi05_geometry",
            "policy.device": budget.device,
            "policy.push_to_hub": "false",
            "policy.paligemma_variant": budget.variant,
            "policy.action_expert_variant": budget.variant,
            "policy.image_resolution": f"[{budget.image_size}, {budget.image_size}]",
            "policy.chunk_size": budget.chunk_size,
            "policy.n_action_steps": budget.action_steps,
            "policy.max_action_dim": 4,
            "policy.num_inference_steps": 5,
            "policy.flow_samples": budget.flow_samples,
            "policy.optimizer_lr": budget.learning_rate,
            "policy.scheduler_decay_lr": budget.learning_rate / 20,
            "policy.scheduler_warmup_steps": min(50, budget.steps),
            "policy.scheduler_decay_steps": budget.steps,
            **self.arm.options,
            "dataset.repo_id": f"local/{self.task}",
            "dataset.root": self.data_folder,
            "batch_size": budget.batch_size,
            "steps": budget.steps,
            "num_workers": 0,
            "log_freq": self.log_every,
            "save_freq": budget.steps,
            "seed": self.seed,
            "output_dir": output,
        }
        return option_list(options)

    def evaluate(self, condition: str, report_progress: ReportProgress) -> None:
        about, budget = find_condition(condition), self.budget
        environment = MetaworldRgbdEnv(
            task=self.task, cameras=about.cameras, sensor=about.sensor, image_size=budget.image_size
        )
        evaluate(
            load_policy(self.checkpoint, budget.device, environment),
            environment,
            budget.evaluation_episodes,
            parallel=budget.parallel,
            videos=budget.videos,
            progress=lambda done: report_progress(f"evaluate {condition}", done, budget.evaluation_episodes),
        ).save(self.outcome(condition))


def runs_of(spec: StudySpec, root: Path) -> list[SimulatedRun]:
    """Every run of a study, seed by seed, so that an interrupted study has complete seeds.

    An arm that several blocks name for a task is one run, evaluated under the conditions of all of them.
    """
    wanted: dict[tuple[str, str], dict[str, None]] = {}
    for comparison in spec.comparisons:
        for task, arm in itertools.product(comparison.tasks, comparison.arms):
            wanted.setdefault((task, arm), {}).update(dict.fromkeys(comparison.conditions))
    return [
        SimulatedRun(root.absolute(), arm, seed, tuple(conditions), task, spec.budget)
        for seed in spec.seeds
        for (task, arm), conditions in wanted.items()
    ]


def from_json(content: dict[str, Any]) -> SimulatedRun:
    """The run that `to_json` wrote."""
    return SimulatedRun(
        Path(content["root"]),
        content["arm_name"],
        content["seed"],
        tuple(content["conditions"]),
        content["task"],
        Budget(**content["budget"]),
    )
