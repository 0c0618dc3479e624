"""What a study is: tasks x arms x seeds x conditions, and a budget for every run. Read from a small TOML file.

seeds = [0, 1, 2]

[budget]                        # any field of `Budget`; what is left out keeps its default
steps = 1500

[[compare]]                     # as many blocks as you like; what two of them ask of the same arm adds up
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
    """What every run may spend, and the sizes of all networks. docs/results.md says how the defaults were chosen."""

    variant: str = "small"
    episodes: int = 200  # of the expert, to learn from
    steps: int = 1500
    batch_size: int = 16
    learning_rate: float = 1e-3
    flow_samples: int = 4
    chunk_size: int = 8
    action_steps: int = 2  # of a chunk, before the next one is predicted
    image_size: int = 84
    evaluation_episodes: int = 50
    parallel: int = 10  # episodes stepped together
    videos: int = 2  # episodes of each cell to keep frames of
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
    """A study from a TOML file, or one of those that come with the package, by name (`default`, `smoke`).

    Raises FileNotFoundError or ValueError with one sentence for a file that is not there or says something unknown.
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
    _only(content, {"seeds", "budget", "compare"}, str(file))
    comparisons = []
    for block in content.get("compare", []):
        _only(block, {f.name for f in fields(Comparison)}, f"[[compare]] of {file}")
        lists = {name: tuple(block.get(name, ())) for name in ("tasks", "arms", "conditions")}
        for name, values in lists.items():
            if not values:
                raise ValueError(f"A [[compare]] block of {file} has no {name}.")
        for task in lists["tasks"]:
            find_task(task)
        comparisons.append(Comparison(**lists))
    budget = content.get("budget", {})
    _only(budget, {f.name for f in fields(Budget)}, f"[budget] of {file}")
    return StudySpec(tuple(content.get("seeds", ())), tuple(comparisons), Budget(**budget))


def _only(content: dict[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        raise ValueError(
            f"{where} has {', '.join(unknown)}, which means nothing; known are {', '.join(sorted(known))}."
        )
