"""The cost of a study in core-hours, estimated from a measurement on this machine before it starts."""

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from torch.utils.data import default_collate

from ..checkpoint.load import LoadedPolicy
from ..configuration_pi05_geometry import PI05GeometryConfig
from ..sim.evaluate import evaluate
from .adapted import AdaptedRun
from .conditions import DENOISING_STEPS
from .frames_in_memory import FramesInMemory
from .plan import runs_of, sweep_runs
from .pretraining import PretrainingRun, pretraining_run
from .recordings import Recording
from .simulated import SimulatedRun
from .simulated_tasks import simulated_task
from .spec import Budget, StudySpec

_RECORDED, _TRAINED = 2, 3  # episodes and steps of the measurement


@dataclass(frozen=True)
class Costs:
    """Core-seconds of a training step, of an evaluation episode that runs to its limit, and of a recorded episode."""

    step: float
    episode: float
    recording: float


@dataclass(frozen=True)
class Estimate:
    """Core-hours that are left: if every arm stops improving as early as the rule allows, and if none does."""

    least: float
    most: float


def measure_costs(budget: Budget, task: str) -> Costs:
    """Record, train and evaluate for some seconds with a new policy with geometry. CPU time, in one thread.

    The measured policy fails, so its episodes run to their limit: an upper bound.
    """
    with _one_thread(), tempfile.TemporaryDirectory() as folder:
        recording = Recording(Path(folder), task, "train", _RECORDED, budget.image_size)
        start = time.process_time()
        recording.make(lambda *_: None)
        recorded = time.process_time() - start
        loaded = _new_policy(budget, recording)
        step = _time_steps(loaded, recording, budget)
        environment = simulated_task(task).environment("train", budget.image_size)
        episodes = min(budget.parallel, budget.evaluation_episodes)
        start = time.process_time()
        evaluate(loaded, environment, episodes, parallel=episodes)
        evaluated = time.process_time() - start
    return Costs(step, evaluated / episodes, recorded / _RECORDED)


def estimate(spec: StudySpec, root: Path, costs: Costs) -> Estimate:
    """Core-hours of what is missing of a study."""
    multiples = spec.growth.multiples
    return Estimate(*(_hours(spec, root, costs, multiples[:count]) for count in (2, len(multiples))))


def _hours(spec: StudySpec, root: Path, costs: Costs, multiples: Sequence[int]) -> float:
    every = [run for multiple in spec.growth.multiples for run in runs_of(spec, root, multiple)]
    trained = [run for run in every if run.multiple in multiples or run.checkpoint.exists()]
    runs: list[PretrainingRun | SimulatedRun] = list(trained)
    if spec.pretraining is not None:
        runs.append(pretraining_run(root, spec.pretraining, spec.budget))
    recordings = {recording.folder: recording for run in runs for recording in _recordings(run)}
    episodes = sum(recording.episodes for folder, recording in recordings.items() if not folder.exists())
    seconds = costs.recording * episodes + sum(_training(run, costs) + _evaluation(run, costs) for run in runs)
    if spec.sweep is not None:
        seconds += sum(_evaluation(run, costs) for run in sweep_runs(spec, trained))
    return seconds / 3600


def _recordings(run: PretrainingRun | SimulatedRun) -> list[Recording]:
    if isinstance(run, PretrainingRun):
        return run.recordings
    if isinstance(run, AdaptedRun):
        return [run.demonstration(condition) for condition in run.distinct_conditions()]
    return [run.recording]


def _training(run: PretrainingRun | SimulatedRun, costs: Costs) -> float:
    """Core-seconds of a run's training that is not done yet."""
    done = isinstance(run, AdaptedRun) or run.checkpoint.exists()
    return 0.0 if done else run.steps * costs.step


def _evaluation(run: PretrainingRun | SimulatedRun, costs: Costs) -> float:
    """Core-seconds of the evaluations of a run that are not done yet, with the adaptations that they need."""
    adaptation = run.budget.adaptation_steps * costs.step if isinstance(run, AdaptedRun) else 0.0
    return len(run.missing()) * (run.evaluation_size * costs.episode + adaptation)


def _new_policy(budget: Budget, recording: Recording) -> LoadedPolicy:
    """An untrained policy with geometry, of the budget's sizes."""
    config = PI05GeometryConfig(
        paligemma_variant=budget.variant,
        action_expert_variant=budget.variant,
        image_resolution=(budget.image_size, budget.image_size),
        chunk_size=budget.chunk_size,
        n_action_steps=budget.action_steps,
        max_action_dim=recording.simulated.action_dim,
        num_inference_steps=DENOISING_STEPS,
        flow_samples=budget.flow_samples,
        device=budget.device,
        push_to_hub=False,
    )
    meta = LeRobotDatasetMetadata(recording.repo_id, root=recording.folder)
    policy = make_policy(config, ds_meta=meta)
    return LoadedPolicy(policy, *make_pre_post_processors(policy.config, dataset_stats=meta.stats))


def _time_steps(loaded: LoadedPolicy, recording: Recording, budget: Budget) -> float:
    """Core-seconds of a training step, after one step that warms up."""
    policy = loaded.policy
    fps = LeRobotDatasetMetadata(recording.repo_id, root=recording.folder).fps
    chunk = {"action": [step / fps for step in range(budget.chunk_size)]}
    frames = FramesInMemory(LeRobotDataset(recording.repo_id, root=recording.folder, delta_timestamps=chunk))
    batch = default_collate([frames[index % len(frames)] for index in range(budget.batch_size)])
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    start = 0.0
    for step in range(1 + _TRAINED):
        if step == 1:
            start = time.process_time()
        policy(loaded.preprocess(dict(batch)))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    policy.eval()
    return (time.process_time() - start) / _TRAINED


@contextmanager
def _one_thread() -> Iterator[None]:
    """As in a run's process."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
