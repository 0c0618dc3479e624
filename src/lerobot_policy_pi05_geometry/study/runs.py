"""One run of a study: train an arm from a seed, then evaluate it under conditions. Where it is kept, what it needs.

```
   <root>/runs/<name>-<hash>/    run.json                  the run, for its worker
                                 run.log                   LeRobot's own training log, and what followed
                                 trained/                  LeRobot's output folder
                                 <condition>-<hash>.npz    what came out
                                 crashed.json              only if it crashed
```

The hashes are of everything the result depends on, so a folder can be used again and again: what is there is not done
again, and another budget is another run.
"""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from .arms import Arm, find_arm

Say = Callable[[str, int, int], None]  # what is being done, how much of it is done, how much there is


@dataclass(frozen=True)
class Run(ABC):
    """A training run and the conditions it is evaluated under."""

    root: Path
    arm_name: str
    seed: int
    conditions: tuple[str, ...]

    @property
    @abstractmethod
    def name(self) -> str:
        """What people call it."""

    @property
    @abstractmethod
    def steps(self) -> int:
        """Training steps."""

    @property
    @abstractmethod
    def evaluation_size(self) -> int:
        """Episodes or frames per condition, for the estimate of the time left."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """What the trained policy depends on."""

    @abstractmethod
    def evaluation_description(self, condition: str) -> dict[str, Any]:
        """What else the outcome under a condition depends on."""

    @abstractmethod
    def own_conditions(self) -> list[str]:
        """Conditions that have to be evaluated for this run."""

    @abstractmethod
    def prepare(self, say: Say) -> None:
        """Make what training needs; several runs may share it, and call this at the same time."""

    @abstractmethod
    def train(self, output: Path) -> None:
        """Train into LeRobot's output folder."""

    @abstractmethod
    def evaluate(self, condition: str, say: Say) -> None:
        """Evaluate the checkpoint and write the outcome."""

    @property
    def log_every(self) -> int:
        """Steps between two lines of the training log."""
        return max(1, self.steps // 60)

    @property
    def arm(self) -> Arm:
        return find_arm(self.arm_name)

    @cached_property
    def folder(self) -> Path:
        # Kept, since a launcher asks all the time, and what the hash is made of takes time to read.
        return self.root / "runs" / f"{self.name}-{short_hash(self.description())}"

    @property
    def checkpoint(self) -> Path:
        """The trained policy."""
        return self.folder / "trained" / "checkpoints" / "last" / "pretrained_model"

    @property
    def log(self) -> Path:
        return self.folder / "run.log"

    @property
    def crash(self) -> Path:
        return self.folder / "crashed.json"

    def outcome(self, condition: str) -> Path:
        """Where the outcome of one of its own conditions is kept."""
        return self.folder / f"{condition}-{short_hash(self.evaluation_description(condition))}.npz"

    def missing(self) -> list[str]:
        """Conditions that have not been evaluated yet."""
        return [condition for condition in self.own_conditions() if not self.outcome(condition).exists()]

    def to_json(self) -> str:
        """Everything a worker needs."""
        return json.dumps({"kind": type(self).__name__, **asdict(self)}, default=str)


@cache
def versions(*packages: str) -> dict[str, str]:
    """What a result also depends on."""
    return {name: version(name) for name in packages}


def short_hash(content: dict[str, Any]) -> str:
    """Ten digits that change with the content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:10]


def option_list(options: dict[str, Any]) -> list[str]:
    """Options as lerobot-train takes them."""
    return [f"--{name}={value}" for name, value in options.items()]
