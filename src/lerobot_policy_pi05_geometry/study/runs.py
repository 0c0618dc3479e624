"""One run of a study: train an arm from a seed, then evaluate it under conditions. Its inputs and its folder.

```
   <root>/runs/<name>-<hash>/    run.json                  the run, for its worker
                                 run.log                   LeRobot's training log, then the evaluation's progress
                                 trained/                  LeRobot's output folder
                                 <condition>-<hash>.npz    outcome of an evaluation
                                 crashed.json              only if it crashed
```

A hash covers everything that the result depends on. So a folder can be reused: finished parts are not repeated, and another
budget is another run.
"""

import hashlib
import json
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lerobot.utils.constants import TRAINING_STATE_DIR

from .arms import Arm, find_arm

ReportProgress = Callable[[str, int, int], None]  # (stage, work done, total work)


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
        """Name of the run, for people."""

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
        """Everything that the trained policy depends on."""

    @abstractmethod
    def evaluation_description(self, condition: str) -> dict[str, Any]:
        """What the outcome under a condition depends on in addition."""

    @abstractmethod
    def distinct_conditions(self) -> list[str]:
        """Conditions to evaluate: those that differ for this arm."""

    @abstractmethod
    def prepare(self, report_progress: ReportProgress) -> None:
        """Create the inputs of training. Several runs may share them and call this at the same time."""

    @abstractmethod
    def train(self, output: Path) -> None:
        """Train into LeRobot's output folder."""

    @abstractmethod
    def evaluate(self, condition: str, report_progress: ReportProgress) -> None:
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
        # Cached: the launcher reads it often, and some descriptions read files.
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
        """File of the outcome under one of its distinct conditions."""
        return self.folder / f"{file_name(condition)}-{short_hash(self.evaluation_description(condition))}.npz"

    def missing(self) -> list[str]:
        """Conditions that have not been evaluated yet."""
        return [condition for condition in self.distinct_conditions() if not self.outcome(condition).exists()]

    def complete(self) -> bool:
        """Whether it is trained and evaluated under all its conditions."""
        return self.checkpoint.exists() and not self.missing()

    def train_missing(self) -> None:
        """Train it unless it is trained. Hold the lock of its folder."""
        if self.checkpoint.exists():
            return
        output = self.folder / "training"
        shutil.rmtree(output, ignore_errors=True)  # of an interrupted training
        self.train(output)
        # LeRobot's optimiser state: twice the size of the weights, and a run is never resumed from it.
        shutil.rmtree(output / "checkpoints" / "last" / TRAINING_STATE_DIR)
        output.rename(self.folder / "trained")

    def to_json(self) -> str:
        """The run as JSON, for its worker."""
        return json.dumps({"kind": type(self).__name__, **asdict(self)}, default=str)


@cache
def versions(*packages: str) -> dict[str, str]:
    """Installed versions; results depend on them too."""
    return {name: version(name) for name in packages}


def short_hash(content: dict[str, Any]) -> str:
    """First ten hexadecimal digits of a SHA-256 of the content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:10]


def file_name(name: str) -> str:
    """The name of a task or a condition as part of a file's."""
    return name.replace("/", "-")


def option_list(options: dict[str, Any]) -> list[str]:
    """Options as lerobot-train takes them."""
    return [f"--{name}={value}" for name, value in options.items()]
