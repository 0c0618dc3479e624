"""A run in the simulator: the same expert episodes for every arm, success on the same evaluation seeds."""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.envs.configs import EnvConfig

from ..checkpoint.load import LoadedPolicy, load_policy
from ..sim.evaluate import Evaluation, evaluate
from ..sim.sensor import SENSORS
from .arms import blind_inputs
from .conditions import equivalent_condition, find_condition
from .pretraining import EVALUATION, PretrainingRun, pretraining_run, read_pretraining
from .recordings import Recording
from .runs import ReportProgress, Run, file_name, option_list, short_hash, versions
from .simulated_tasks import SimulatedTask, simulated_task
from .spec import Budget, Pretraining
from .training import train_with
from .training_options import dataset_options, network_options, training_options
from .warm_start import make_start, remaining_options


@dataclass(frozen=True)
class SimulatedRun(Run):
    """A task, an arm and a training seed.

    pretraining: the π0.5 to start from; None trains from scratch. multiple: of the budget's steps, with those of a run
    before it.
    """

    task: str
    budget: Budget
    pretraining: Pretraining | None = None
    multiple: int = 1

    @property
    def name(self) -> str:
        times = f"-x{self.multiple}" if self.multiple > 1 else ""
        return f"{file_name(self.task)}-{self.arm_name}-{self.seed}{times}"

    @property
    def steps(self) -> int:
        earlier = 0 if self.before is None else self.before.multiple
        return (self.multiple - earlier) * self.budget.steps

    @property
    def evaluation_size(self) -> int:
        return self.budget.evaluation_episodes

    @cached_property
    def simulated(self) -> SimulatedTask:
        return simulated_task(self.task)

    @property
    def options(self) -> dict[str, str]:
        """The arm's options of lerobot-train, for this task."""
        return {**self.arm.options, **(blind_inputs([self.simulated.state_dim]) if self.arm.blind else {})}

    @cached_property
    def recording(self) -> Recording:
        """The expert episodes that it is trained on."""
        return Recording(self.root, self.task, self.arm.cameras, self.budget.episodes, self.budget.image_size)

    @property
    def data_folder(self) -> Path:
        return self.recording.folder

    @cached_property
    def origin(self) -> PretrainingRun | None:
        """The pretraining that it starts from, if any."""
        return None if self.pretraining is None else pretraining_run(self.root, self.pretraining, self.budget)

    @cached_property
    def before(self) -> "SimulatedRun | None":
        """The run with the first half of the steps, if the arm has one; this run goes on from its policy."""
        if self.arm.after is None:
            return None
        half = self.multiple // 2
        return SimulatedRun(self.root, self.arm.after, self.seed, (), self.task, self.budget, self.pretraining, half)

    @property
    def source(self) -> Path | None:
        """The checkpoint that is converted for it; None if it is trained from scratch."""
        if self.before is not None:
            return self.before.checkpoint
        return None if self.origin is None else self.origin.pi05

    @property
    def start(self) -> Path:
        """The converted checkpoint that it starts from. Runs with other numbers of steps share it if their source is the same."""
        origin = self.before or self.origin
        assert origin is not None
        content = {"origin": origin.description(), "options": self.options, "seed": self.seed}
        return self.root / "starts" / f"{self.arm_name}-{self.seed}-{short_hash(content)}"

    def description(self) -> dict[str, Any]:
        budget = {name: value for name, value in asdict(self.budget).items() if name not in EVALUATION}
        return {
            "arm": self.arm_name,
            "options": self.options,
            "seed": self.seed,
            "budget": budget,
            "multiple": self.multiple,
            "origin": None if self.origin is None else self.origin.description(),
            "data": self.recording.description(),
            "versions": versions(*self.simulated.packages),
            **({} if self.before is None else {"before": self.before.description()}),
        }

    def evaluation_description(self, condition: str) -> dict[str, Any]:
        about = find_condition(condition)
        return {
            "cameras": self.simulated.camera_description(about.cameras),
            "sensor": asdict(SENSORS[about.sensor]),
            "budget": {name: getattr(self.budget, name) for name in EVALUATION},
            "denoising_steps": about.denoising_steps,
        }

    def distinct_conditions(self) -> list[str]:
        return list(dict.fromkeys(equivalent_condition(condition, self.arm) for condition in self.conditions))

    def evaluation(self, condition: str) -> Evaluation | None:
        """The episodes of a condition; None before evaluation."""
        path = self.outcome(equivalent_condition(condition, self.arm))
        return Evaluation.load(path) if path.exists() else None

    def prepare(self, report_progress: ReportProgress) -> None:
        self.recording.make(report_progress)
        if self.before is not None and not self.before.checkpoint.exists():
            raise FileNotFoundError(f"Run {self.name} goes on from run {self.before.name}, which has not been trained.")
        if self.source is not None:
            make_start(self.source, self.start, self.arm.options, self.simulated.views, self.seed)

    def train(self, output: Path) -> None:
        train_with(self.arguments(output))

    def arguments(self, output: Path) -> list[str]:
        """lerobot-train's arguments."""
        if self.source is None:
            begin = {**network_options(self.budget, self.simulated.action_dim), **self.options}
        else:
            begin = {"policy.path": self.start, **remaining_options(self.options)}
        return option_list(
            {
                **begin,
                **training_options(self.budget, self.steps, self.budget.learning_rate, self.seed, self.log_every),
                **dataset_options(self.data_folder, self.recording.repo_id, output),
            }
        )

    def load(self, condition: str, environment: EnvConfig) -> LoadedPolicy:
        """The policy to evaluate under a condition."""
        steps = find_condition(condition).denoising_steps
        return load_policy(self.checkpoint, self.budget.device, environment, num_inference_steps=steps)

    def evaluate(self, condition: str, report_progress: ReportProgress) -> None:
        about, budget = find_condition(condition), self.budget
        environment = self.simulated.environment(about.cameras, budget.image_size, about.sensor)
        evaluate(
            self.load(condition, environment),
            environment,
            budget.evaluation_episodes,
            parallel=budget.parallel,
            videos=budget.videos,
            progress=lambda done: report_progress(f"evaluate {condition}", done, budget.evaluation_episodes),
        ).save(self.outcome(condition))


def run_arguments(content: dict[str, Any]) -> dict[str, Any]:
    """Arguments of a `SimulatedRun`'s constructor from `to_json`'s content."""
    pretraining = content["pretraining"]
    return {
        "root": Path(content["root"]),
        "arm_name": content["arm_name"],
        "seed": content["seed"],
        "conditions": tuple(content["conditions"]),
        "task": content["task"],
        "budget": Budget(**content["budget"]),
        "pretraining": None if pretraining is None else read_pretraining(pretraining),
        "multiple": content["multiple"],
    }


def from_json(content: dict[str, Any]) -> SimulatedRun:
    """The run that `to_json` wrote."""
    return SimulatedRun(**run_arguments(content))
