"""Outcomes of studies, without training: files where a run keeps its checkpoint and its episodes."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lerobot_policy_pi05_geometry.sim.evaluate import Evaluation
from lerobot_policy_pi05_geometry.study.pretraining import PretrainingRun
from lerobot_policy_pi05_geometry.study.simulated import SimulatedRun

Rate = Callable[[PretrainingRun | SimulatedRun, str], float]  # success rate of a run under a condition


def fake_outcomes(runs: Sequence[PretrainingRun | SimulatedRun], rate: Rate) -> None:
    """Complete runs: the first episodes of each cell succeed."""
    for run in runs:
        run.checkpoint.mkdir(parents=True, exist_ok=True)
        run.folder.mkdir(parents=True, exist_ok=True)
        for condition in run.missing():
            episodes = run.evaluation_size
            wins = round(rate(run, condition) * episodes)
            successes = (np.arange(episodes) < wins).tolist()
            Evaluation(list(range(episodes)), successes, [5] * episodes).save(Path(run.outcome(condition)))
