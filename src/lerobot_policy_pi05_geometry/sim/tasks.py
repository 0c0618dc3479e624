"""Tasks: object ranges and instructions.

All 50 Meta-World v3 tasks are available under their own names with their own object ranges. Those ranges are small: a policy
without a camera often succeeds. The `-wide` tasks have larger ranges, so that success requires observing the object.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TaskSpec:
    """A task: Meta-World's environment, the instruction, and the object's range (None: Meta-World's).

    object_range: low and high corner of the reset vector, metres. max_steps: control steps of an episode.
    """

    environment: str
    instruction: str
    object_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    max_steps: int = 40


WIDE_TASKS = {
    "button-press-topdown-wide": TaskSpec(
        "button-press-topdown-v3",
        "press the button from the top",
        ((-0.25, 0.65, 0.115), (0.25, 0.90, 0.115)),
    ),
    "faucet-open-wide": TaskSpec(
        "faucet-open-v3",
        "turn the faucet open",
        ((-0.20, 0.65, 0.0), (0.20, 0.90, 0.0)),
    ),
    "coffee-button-wide": TaskSpec(
        "coffee-button-v3",
        "press the button of the coffee machine",
        ((-0.20, 0.75, -0.001), (0.20, 0.95, 0.001)),
    ),
    "button-press-wide": TaskSpec(
        "button-press-v3",
        "press the button from the front",
        ((-0.30, 0.75, 0.115), (0.30, 0.95, 0.1151)),
    ),
    "handle-press-wide": TaskSpec(
        "handle-press-v3",
        "press the handle down",
        ((-0.30, 0.65, -0.001), (0.30, 0.90, 0.001)),
    ),
    "drawer-open-wide": TaskSpec(
        "drawer-open-v3",
        "open the drawer",
        ((-0.30, 0.70, 0.0), (0.30, 0.90, 0.0)),
        max_steps=60,
    ),
}


def find_task(name: str) -> TaskSpec:
    """The task of this name. Raises ValueError that lists the known names."""
    if name in WIDE_TASKS:
        return WIDE_TASKS[name]
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    if name not in ALL_V3_ENVIRONMENTS:
        known = ", ".join([*WIDE_TASKS, *ALL_V3_ENVIRONMENTS])
        raise ValueError(f"There is no simulated task '{name}'; choose one of: {known}.")
    return TaskSpec(name, name.removesuffix("-v3").replace("-", " "), max_steps=125)


def make_simulator(task: TaskSpec):
    """Meta-World's environment of a task, fully observable (for its expert) and seeded."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    simulator = ALL_V3_ENVIRONMENTS[task.environment]()
    # `set_task` does this from a pickled task. The cached observation space was made with a hidden goal: `step` would clip
    # the goal out of the observation, and experts that need it would fail.
    simulator._set_task_called = True
    simulator._partially_observable = False
    vars(simulator).pop("sawyer_observation_space", None)
    simulator._freeze_rand_vec = False
    simulator.seeded_rand_vec = True
    if task.object_range is not None:
        low, high = (np.array(corner) for corner in task.object_range)
        simulator._random_reset_space.low[:] = low
        simulator._random_reset_space.high[:] = high
    return simulator


def make_expert(task: TaskSpec):
    """Meta-World's scripted policy for a task; it reads the simulator's full state."""
    from metaworld.policies import ENV_POLICY_MAP

    return ENV_POLICY_MAP[task.environment]()  # type: ignore[abstract]
