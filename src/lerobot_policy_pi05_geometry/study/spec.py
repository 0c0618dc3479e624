"""A study: tasks x arms x seeds x conditions, and a budget for every run. Read from a TOML file.

seeds = [0, 1, 2]

[budget]                        # any field of `Budget`; other fields keep their defaults
steps = 1500

[pretrain]                      # optional: train a π0.5 on RGB first, and start every arm from it (`Pretraining`)
tasks = ["faucet-open-wide", "coffee-button-wide"]

[growth]                        # optional: train with multiples of the budget's steps, until success stops growing (`Growth`)
multiples = [1, 2, 4]

[sweep]                         # optional: evaluate the longest training of these arms at these azimuths (`Sweep`)
azimuths = [-60, -30, 0, 30, 60]
arms = ["rgb", "geometry"]

[[compare]]                     # any number of blocks; an arm in two of them is trained once, for the conditions of both
tasks = ["button-press-topdown-wide"]
arms = ["blind", "rgb", "geometry"]
conditions = ["inside", "outside"]
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS
from .arms import find_arm, refuse_from_scratch
from .conditions import azimuth_condition, find_condition
from .simulated_tasks import simulated_task
from .value_checks import check_values

STUDIES = Path(__file__).parent / "studies"


@dataclass(frozen=True)
class Budget:
    """Training and evaluation budget of every run, and the network size. Defaults: see docs/results.md."""

    variant: str = "small"
    episodes: int = 200  # expert episodes in the training data
    steps: int = 1500
    batch_size: int = 16
    learning_rate: float = 1e-3
    flow_samples: int = 4
    chunk_size: int = 8
    action_steps: int = 2  # executed steps of a chunk before the next one is predicted
    image_size: int = 84
    evaluation_episodes: int = 50
    parallel: int = 10  # episodes stepped together
    videos: int = 2  # episodes of each cell whose frames are kept
    adaptation_steps: int = 200  # of an arm that is adapted with one demonstration
    device: str = "cpu"

    def __post_init__(self) -> None:
        counts = [field.name for field in fields(self) if field.type is int]
        check_values(self, "[budget]", {**dict.fromkeys(counts, 1), "videos": 0})
        variants = [name for name in PALIGEMMA_VARIANTS if name in EXPERT_VARIANTS]
        if self.variant not in variants:
            raise ValueError(f"[budget] variant must be one of {', '.join(variants)}, got '{self.variant}'.")
        if self.learning_rate <= 0:
            raise ValueError(f"[budget] learning_rate must be above 0, got {self.learning_rate}.")
        if self.action_steps > self.chunk_size:
            raise ValueError(
                f"[budget] action_steps ({self.action_steps}) cannot exceed chunk_size ({self.chunk_size}): no more steps are "
                "predicted."
            )


@dataclass(frozen=True)
class Pretraining:
    """A π0.5 trained on RGB, from which every arm is fine-tuned. Network and batch size are the budget's.

    cameras: range of camera poses. episodes: expert episodes of each task. seed: of the training. evaluated: tasks on which
    the trained π0.5 is evaluated, for the report.
    """

    tasks: tuple[str, ...]
    cameras: str = "wide"
    episodes: int = 100
    steps: int = 6000
    learning_rate: float = 1e-3
    seed: int = 0
    evaluated: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_values(self, "[pretrain]", {"episodes": 1, "steps": 1, "seed": 0})
        if self.learning_rate <= 0:
            raise ValueError(f"[pretrain] learning_rate must be above 0, got {self.learning_rate}.")
        if not self.tasks:
            raise ValueError("[pretrain] needs at least one task.")
        unknown = sorted(set(self.evaluated) - set(self.tasks))
        if unknown:
            raise ValueError(f"[pretrain] evaluates {', '.join(unknown)}, on which it is not trained.")
        for task in self.tasks:
            simulated_task(task).camera_description(self.cameras)


@dataclass(frozen=True)
class Growth:
    """Budgets of a study, as multiples of the budget's steps, and the rule by which an arm gets the next one.

    Each multiple is a training of its own with its own learning-rate schedule, as a user with so many steps gets it. An arm
    has stopped improving when the gain from one multiple to the next, pooled over training seeds and tasks, is below
    `gain` under each of the conditions; then larger multiples are not trained.
    """

    multiples: tuple[int, ...] = (1,)
    gain: float = 0.05
    conditions: tuple[str, ...] = ("inside", "outside")

    def __post_init__(self) -> None:
        check_values(self, "[growth]", {})
        if not self.multiples or list(self.multiples) != sorted(set(self.multiples)) or self.multiples[0] < 1:
            raise ValueError(f"[growth] multiples must be whole numbers that rise from 1 on, got {self.multiples}.")
        for name in self.conditions:
            find_condition(name)

    def multiples_of(self, arm: str) -> tuple[int, ...]:
        """The multiples that an arm can be trained with: all, or for an arm after another one those whose half is trained."""
        if find_arm(arm).after is None:
            return self.multiples
        return tuple(multiple for multiple in self.multiples if multiple / 2 in self.multiples)


@dataclass(frozen=True)
class Sweep:
    """Azimuths (degrees, relative to the middle of the training range) at which arms are evaluated at the end."""

    azimuths: tuple[float, ...]
    arms: tuple[str, ...]

    def __post_init__(self) -> None:
        check_values(self, "[sweep]", {})
        if not self.azimuths or not self.arms:
            raise ValueError("[sweep] needs at least one azimuth and one arm.")
        if any(abs(degrees) > 180 for degrees in self.azimuths):
            raise ValueError(f"[sweep] azimuths must be within -180 and 180 degrees, got {list(self.azimuths)}.")


@dataclass(frozen=True)
class Comparison:
    """Every arm on every task, under every condition."""

    tasks: tuple[str, ...]
    arms: tuple[str, ...]
    conditions: tuple[str, ...]

    def __post_init__(self) -> None:
        check_values(self, "[[compare]]", {})


@dataclass(frozen=True)
class StudySpec:
    """A whole study."""

    seeds: tuple[int, ...]
    comparisons: tuple[Comparison, ...]
    budget: Budget = Budget()
    pretraining: Pretraining | None = None
    growth: Growth = Growth()
    sweep: Sweep | None = None

    def __post_init__(self) -> None:
        check_values(self, "The study's", {"seeds": 0})
        if not self.seeds or not self.comparisons:
            raise ValueError("A study needs at least one training seed and one [[compare]] block.")
        for comparison in self.comparisons:
            for name in comparison.arms:
                adapted = find_arm(name).adapts
                if adapted is not None and adapted not in comparison.arms:
                    raise ValueError(f"Arm '{name}' adapts arm '{adapted}'; name both in the same [[compare]] block.")
                self._check_halves(name, comparison)
                if self.pretraining is not None:
                    refuse_from_scratch(name)
            for name in comparison.conditions:
                find_condition(name)
            if len(self.growth.multiples) > 1 and not set(self.growth.conditions) <= set(comparison.conditions):
                raise ValueError(
                    f"[growth] decides by the conditions {', '.join(self.growth.conditions)}; name them in every [[compare]] "
                    "block."
                )
        self._check_tasks()
        arms = {name for comparison in self.comparisons for name in comparison.arms}
        missing = sorted(set(self.sweep.arms) - arms) if self.sweep is not None else []
        if missing:
            raise ValueError(f"[sweep] names {', '.join(missing)}, which no [[compare]] block trains.")

    def _check_halves(self, name: str, comparison: Comparison) -> None:
        """Raise ValueError for an arm after another one (its first half of the steps) that the study does not train."""
        first = find_arm(name).after
        if first is None:
            return
        if first not in comparison.arms:
            raise ValueError(f"Arm '{name}' goes on from arm '{first}'; name both in the same [[compare]] block.")
        if not self.growth.multiples_of(name):
            raise ValueError(
                f"Arm '{name}' has half of its steps from arm '{first}', so it needs two multiples of which one is twice "
                f"the other, such as multiples = [1, 2] in [growth]; got {list(self.growth.multiples)}."
            )

    def _check_tasks(self) -> None:
        """Raise ValueError for an unknown task or camera range, or tasks that one pretraining cannot serve."""
        for comparison in self.comparisons:
            ranges = {find_condition(name).cameras for name in comparison.conditions}
            ranges |= {find_arm(name).cameras for name in comparison.arms}
            for task in comparison.tasks:
                for cameras in sorted(ranges):
                    simulated_task(task).camera_description(cameras)
                if self.sweep is not None and set(self.sweep.arms) & set(comparison.arms):
                    _check_azimuths(task, self.sweep.azimuths)
        if self.pretraining is None:
            return
        names = (*self.pretraining.tasks, *(task for comparison in self.comparisons for task in comparison.tasks))
        tasks = [simulated_task(name) for name in names]
        if len({(task.views, task.state_dim, task.action_dim) for task in tasks}) > 1:
            raise ValueError(
                f"[pretrain] and [[compare]] need tasks of the same cameras, state and actions, got {', '.join(names)}."
            )


def _check_azimuths(task: str, azimuths: Sequence[float]) -> None:
    for degrees in azimuths:
        try:
            simulated_task(task).camera_description(azimuth_condition(degrees))
        except ValueError as error:
            raise ValueError(
                f"[sweep] is not possible on {task}, which one of its arms is trained on: {error}"
            ) from error


def read_spec(path: str | Path) -> StudySpec:
    """A study from a TOML file, or a study of this package by name (`default`, `smoke`).

    Raises FileNotFoundError if there is no such file, and ValueError for invalid TOML or unknown names.
    """
    file = Path(path)
    if not file.is_file() and (STUDIES / f"{path}.toml").is_file():
        file = STUDIES / f"{path}.toml"
    if not file.is_file():
        known = ", ".join(sorted(f.stem for f in STUDIES.glob("*.toml")))
        raise FileNotFoundError(f"There is no study file {path}; give a TOML file, or one of: {known}.")
    try:
        content = tomllib.loads(file.read_text())
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file} is not valid TOML: {error}.") from error
    _check_keys(content, {"seeds", "budget", "pretrain", "growth", "sweep", "compare"}, str(file))
    comparisons = []
    blocks = content.get("compare", [])
    if not isinstance(blocks, list):
        raise ValueError(f"compare of {file} must be blocks, each begun with [[compare]], got {blocks!r}.")
    for block in blocks:
        _check_keys(block, {f.name for f in fields(Comparison)}, f"[[compare]] of {file}")
        lists = {name: _as_tuple(block.get(name, ())) for name in ("tasks", "arms", "conditions")}
        for name, values in lists.items():
            if not values:
                raise ValueError(f"A [[compare]] block of {file} has no {name}.")
        comparisons.append(Comparison(**lists))
    return StudySpec(
        _as_tuple(content.get("seeds", ())),
        tuple(comparisons),
        _section(content, "budget", Budget, file) or Budget(),
        _section(content, "pretrain", Pretraining, file),
        _section(content, "growth", Growth, file) or Growth(),
        _section(content, "sweep", Sweep, file),
    )


def require_tasks(spec: StudySpec) -> None:
    """Raise ModuleNotFoundError with installation advice unless the simulators of a study's tasks are installed."""
    for name in {task for comparison in spec.comparisons for task in comparison.tasks}:
        simulated_task(name).require()


def _section[T](content: dict[str, Any], name: str, kind: type[T], file: Path) -> T | None:
    """A table of the file as a dataclass, lists as tuples; None if the file has no such table."""
    if name not in content:
        return None
    values = content[name]
    _check_keys(values, {f.name for f in fields(kind)}, f"[{name}] of {file}")  # type: ignore[arg-type]
    try:
        return kind(**{key: _as_tuple(value) for key, value in values.items()})
    except TypeError as error:
        raise ValueError(f"[{name}] of {file} is incomplete: {error}.") from error


def _as_tuple(value: Any) -> Any:
    """A list as a tuple; other values are checked where they are used."""
    return tuple(value) if isinstance(value, list) else value


def _check_keys(content: Any, known: set[str], where: str) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where} must be a table of entries ({', '.join(sorted(known))}), got {content!r}.")
    unknown = sorted(set(content) - known)
    if unknown:
        raise ValueError(
            f"{where} has unknown entries {', '.join(unknown)}; known entries are {', '.join(sorted(known))}."
        )
