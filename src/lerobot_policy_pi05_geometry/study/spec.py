"""A study: tasks x arms x seeds x conditions, and a budget for every run. Read from a TOML file.

seeds = [0, 1, 2]

[budget]                        # any field of `Budget`; other fields keep their defaults
steps = 1500

[[compare]]                     # any number of blocks; an arm in two of them is trained once, for the conditions of both
tasks = ["button-press-topdown-wide"]
arms = ["blind", "rgb", "geometry"]
conditions = ["inside", "outside"]
"""

import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..sim.tasks import find_task
from .arms import find_arm
from .conditions import find_condition

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
    device: str = "cpu"


@dataclass(frozen=True)
class Comparison:
    """Every arm on every task, under every condition."""

    tasks: tuple[str, ...]
    arms: tuple[str, ...]
    conditions: tuple[str, ...]


@dataclass(frozen=True)
class StudySpec:
    """A whole study."""

    seeds: tuple[int, ...]
    comparisons: tuple[Comparison, ...]
    budget: Budget = Budget()

    def __post_init__(self) -> None:
        if not self.seeds or not self.comparisons:
            raise ValueError("A study needs at least one training seed and one [[compare]] block.")
        for comparison in self.comparisons:
            for name in comparison.arms:
                find_arm(name)
            for name in comparison.conditions:
                find_condition(name)


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
    _check_keys(content, {"seeds", "budget", "compare"}, str(file))
    comparisons = []
    for block in content.get("compare", []):
        _check_keys(block, {f.name for f in fields(Comparison)}, f"[[compare]] of {file}")
        lists = {name: tuple(block.get(name, ())) for name in ("tasks", "arms", "conditions")}
        for name, values in lists.items():
            if not values:
                raise ValueError(f"A [[compare]] block of {file} has no {name}.")
        for task in lists["tasks"]:
            find_task(task)
        comparisons.append(Comparison(**lists))
    budget = content.get("budget", {})
    _check_keys(budget, {f.name for f in fields(Budget)}, f"[budget] of {file}")
    return StudySpec(tuple(content.get("seeds", ())), tuple(comparisons), Budget(**budget))


def _check_keys(content: dict[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        raise ValueError(
            f"{where} has unknown entries {', '.join(unknown)}; known entries are {', '.join(sorted(known))}."
        )
