"""What success on a task is worth: how often its expert succeeds, and how often a plan does that never looks.

`floors.json` has what was measured, by suite, task and placement; a report shows it beside every success rate. Replace it
by running `pi05-geometry libero-floors`.
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .tasks import LiberoTask

if TYPE_CHECKING:
    from .expert.world import Memory
    from .scene import LiberoScene

FLOORS_FILE = Path(__file__).parent / "floors.json"
FIRST_SEED = 700_000  # apart from evaluation (0) and recording (1,000,000)


@dataclass(frozen=True)
class Floor:
    """Successes of the expert in `episodes` episodes, and of the blind plan in the first `blind_episodes` of the same seeds.

    blind_episodes: 0 where the blind plan was not measured. steps: mean length of the expert's successful episodes.
    seconds: processor time of an expert's episode.
    """

    suite: str
    index: int
    name: str
    placement: str
    episodes: int
    expert: int
    blind_episodes: int
    blind: int
    steps: float
    seconds: float

    def __str__(self) -> str:
        return f"blind plan {self.blind_share}, expert {self.expert_share}"

    @property
    def expert_share(self) -> str:
        """Such as `49/50`."""
        return f"{self.expert}/{self.episodes}"

    @property
    def blind_share(self) -> str:
        """Such as `4/20`, or `not measured`."""
        return f"{self.blind}/{self.blind_episodes}" if self.blind_episodes else "not measured"


def read_floors(path: Path = FLOORS_FILE) -> dict[tuple[str, int, str], Floor]:
    """The measured floors by (suite, task number, placement)."""
    floors = [Floor(**entry) for entry in json.loads(path.read_text())]
    return {(floor.suite, floor.index, floor.placement): floor for floor in floors}


def measure(
    task: LiberoTask,
    placement: str,
    episodes: int,
    blind_episodes: int,
    say: Callable[[str], None] = lambda text: None,
) -> Floor:
    """Run the expert on one task, and the blind plan on the first `blind_episodes` of the same seeds, without rendering.

    Raises ValueError unless `episodes` is 1 or more and `blind_episodes` is no more than that.
    """
    if not 0 <= blind_episodes <= episodes or episodes < 1:
        raise ValueError(
            f"Floors need 1 episode of the expert or more and no more of the blind plan, got {episodes} and "
            f"{blind_episodes}."
        )
    from .expert.world import Memory
    from .scene import LiberoScene

    scene = LiberoScene(task, cameras=())
    try:
        memory = Memory.of(scene, placement) if blind_episodes else None
        lengths, blind, seconds = [], 0, 0.0
        for episode in range(episodes):
            seed = FIRST_SEED + episode
            started = time.process_time()
            lengths.append(_run(scene, seed, placement, None))
            seconds += time.process_time() - started
            if episode < blind_episodes:
                blind += _run(scene, seed, placement, memory) is not None
            say(f"{task.key} {placement}: {episode + 1} of {episodes}")
    finally:
        scene.close()
    steps = [length for length in lengths if length is not None]
    return Floor(
        task.suite,
        task.index,
        task.name,
        placement,
        episodes,
        len(steps),
        blind_episodes,
        blind,
        steps=round(float(np.mean(steps))) if steps else 0,
        seconds=round(seconds / episodes, 1),
    )


def _run(scene: "LiberoScene", seed: int, placement: str, memory: "Memory | None") -> int | None:
    """Steps until an expert (with a memory: a blind plan) reaches the goal, or None."""
    from .expert.expert import SETTLING_STEPS, Expert

    scene.reset(seed, placement)
    expert = Expert(scene, memory)
    for step in range(scene.task.max_steps):
        if scene.step(expert.act())[1]:
            return step + 1
        if expert.idle > SETTLING_STEPS:
            return None
    return None


def write_floors(floors: list[Floor], path: Path) -> None:
    """Write floors; those in the file that were not measured anew stay."""
    known = read_floors(path) if path.exists() else {}
    known.update({(floor.suite, floor.index, floor.placement): floor for floor in floors})
    entries = [asdict(known[key]) for key in sorted(known)]
    path.write_text("[\n" + ",\n".join(f"  {json.dumps(entry)}" for entry in entries) + "\n]\n")
