"""The runs of a simulated study, in phases: what a phase trains depends on what the phases before it showed.

   pretraining ─► trained arms, 1 x the steps ─► adapted arms ─► 2 x the steps ─► ... ─► azimuth sweep

With larger multiples, only arms that have not stopped improving (stopping.py).
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from .adapted import AdaptedRun
from .arms import find_arm
from .conditions import azimuth_condition
from .pretraining import PretrainingRun, pretraining_run
from .results import episodes_table
from .simulated import SimulatedRun
from .spec import StudySpec
from .stopping import gains, improving_arms


@dataclass(frozen=True)
class Phase:
    """Runs that do not depend on each other."""

    title: str
    runs: Sequence[PretrainingRun | SimulatedRun]


def runs_of(spec: StudySpec, root: Path, multiple: int = 1) -> list[SimulatedRun]:
    """Every run of a study with this multiple of the steps, seed by seed, so that an interrupted study has complete seeds.

    An arm that several blocks name for a task is one run, evaluated under the conditions of all of them.
    """
    wanted: dict[tuple[str, str], dict[str, None]] = {}
    for comparison in spec.comparisons:
        for task, arm in itertools.product(comparison.tasks, comparison.arms):
            wanted.setdefault((task, arm), {}).update(dict.fromkeys(comparison.conditions))
    return [
        (SimulatedRun if find_arm(arm).adapts is None else AdaptedRun)(
            root.absolute(), arm, seed, tuple(conditions), task, spec.budget, spec.pretraining, multiple
        )
        for seed in spec.seeds
        for (task, arm), conditions in wanted.items()
        if multiple in spec.growth.multiples_of(arm)
    ]


def phases(spec: StudySpec, root: Path) -> Iterator[Phase]:
    """The phases of a study. A phase has to be complete before the next one is asked for.

    Raises RuntimeError if the pretraining crashed.
    """
    if spec.pretraining is not None:
        pretraining = pretraining_run(root, spec.pretraining, spec.budget)
        yield Phase("pretraining", [pretraining])
        if pretraining.crash.exists():
            raise RuntimeError(
                f"The pretraining crashed ({pretraining.log}), and every run starts from it; start again with "
                "--retry-crashed."
            )
    done: list[SimulatedRun] = []
    for multiple in spec.growth.multiples:
        runs = [run for run in runs_of(spec, root, multiple) if continues(run.arm_name, spec, done, multiple)]
        for adapted, title in ((False, f"{multiple} x the steps"), (True, f"{multiple} x the steps, adapted")):
            part = [run for run in runs if isinstance(run, AdaptedRun) == adapted]
            if part:
                yield Phase(title, part)
        done += runs
    if spec.sweep is not None:
        yield Phase("azimuth sweep", sweep_runs(spec, done))


def continues(arm: str, spec: StudySpec, done: Sequence[SimulatedRun], multiple: int) -> bool:
    """Whether an arm gets this multiple of the steps: it has been trained with all smaller ones and improved with the last."""
    first = find_arm(arm).after
    if first is not None and not any(run.arm_name == first and 2 * run.multiple == multiple for run in done):
        return False  # there is no policy to go on from: that arm stopped improving before
    smaller = [m for m in spec.growth.multiples_of(arm) if m < multiple]
    if len(smaller) < 2:
        return True
    trained = find_arm(arm).adapts or arm  # an adapted arm follows the arm that it adapts
    runs = [run for run in done if run.arm_name == trained and run.multiple in smaller[-2:]]
    if {run.multiple for run in runs} != set(smaller[-2:]):
        return False
    return trained in improving_arms(gains(episodes_table(runs), spec.growth), spec.growth)


def sweep_runs(spec: StudySpec, done: Sequence[SimulatedRun]) -> list[SimulatedRun]:
    """The longest training of the sweep's arms, to be evaluated at its azimuths."""
    assert spec.sweep is not None
    azimuths = tuple(azimuth_condition(degrees) for degrees in spec.sweep.azimuths)
    return [replace(run, conditions=azimuths) for run in longest(done) if run.arm_name in spec.sweep.arms]


def longest(runs: Sequence[SimulatedRun]) -> list[SimulatedRun]:
    """Of each task, arm and training seed, the run with the most steps."""
    found: dict[tuple[str, str, int], SimulatedRun] = {}
    for run in runs:
        key = (run.task, run.arm_name, run.seed)
        if key not in found or run.multiple > found[key].multiple:
            found[key] = run
    return list(found.values())
