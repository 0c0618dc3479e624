"""LIBERO's suites and tasks, in LIBERO's own order, and how far objects move when they are placed anew."""

import _codecs
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy._core.multiarray import _reconstruct

from .installation import libero_files, require_libero

# Longest demonstration and some; LeRobot's numbers (lerobot/envs/libero.py), from OpenVLA's evaluation.
MAX_STEPS = {
    "libero_spatial": 280,
    "libero_object": 280,
    "libero_goal": 300,
    "libero_10": 520,
    "libero_90": 400,
}
# Half the side of the square that an object's place is drawn from, metres; `stock` are LIBERO's own initial states.
PLACEMENTS = {"stock": 0.0, "near": 0.08, "far": 0.18}


@dataclass(frozen=True)
class LiberoTask:
    """One task. `suite` and `index` name it as LeRobot does: `--env.task=libero_goal --env.task_ids=[8]`."""

    suite: str
    index: int
    name: str
    instruction: str
    bddl_file: Path

    @property
    def max_steps(self) -> int:
        return MAX_STEPS[self.suite]

    @property
    def key(self) -> str:
        """Short name in reports, such as `libero_goal/8`."""
        return f"{self.suite}/{self.index}"

    def initial_states(self) -> np.ndarray:
        """LIBERO's own initial states, (N, 1 + nq + nv) float64: time, positions, velocities."""
        import torch

        file = libero_files()[1] / self.suite / f"{self.name}.pruned_init"
        # The file is a pickled numpy array; only what such an array consists of may be loaded.
        rebuild = (_reconstruct, "numpy.core.multiarray._reconstruct")  # numpy 1's name for it
        allowed: list[Any] = [rebuild, np.ndarray, np.dtype, np.dtypes.Float64DType, _codecs.encode]
        with torch.serialization.safe_globals(allowed):
            states = torch.load(file, weights_only=True)
        return np.asarray(states, dtype=np.float64)


@cache
def suite_tasks(suite: str) -> tuple[LiberoTask, ...]:
    """All tasks of a suite. Raises ValueError with the suites there are."""
    if suite not in MAX_STEPS:
        raise ValueError(f"There is no LIBERO suite '{suite}'; choose one of: {', '.join(MAX_STEPS)}.")
    require_libero()
    from libero.libero.benchmark import task_maps

    folder = libero_files()[0] / suite
    return tuple(
        LiberoTask(suite, index, task.name, task.language, folder / task.bddl_file)
        for index, task in enumerate(task_maps[suite].values())
    )


def find_task(suite: str, index: int) -> LiberoTask:
    """The task of this number. Raises ValueError if the suite or the number does not exist."""
    tasks = suite_tasks(suite)
    if not 0 <= index < len(tasks):
        raise ValueError(f"{suite} has the tasks 0 to {len(tasks) - 1}, not {index}.")
    return tasks[index]
