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
    """Successes of the expert and of the blind plan in `episodes` episodes each, on the same seeds.

    blind: None where it was not measured. steps: mean length of the expert's successful episodes. seconds: processor time
    of an expert's episode.
    """

    suite: str
    index: int
    name: str
    placement: str
    episodes: int
    expert: int
    blind: int | None
    steps: float
    seconds: float

    def __str__(self) -> str:
        blind = "not measured" if self.blind is None else f"{self.blind}/{self.episodes}"
        return f"blind plan {blind}, expert {self.expert}/{self.episodes}"


def read_floors(path: Path = FLOORS_FILE) -> dict[tuple[str, int, str], Floor]:
    """The measured floors by (suite, task number, placement)."""
    floors = [Floor(**entry) for entry in json.loads(path.read_text())]
    return {(floor.suite, floor.index, floor.placement): floor for floor in floors}


def measure(
    task: LiberoTask,
    placement: str,
    episodes: int,
    who: tuple[str, ...] = ("expert", "blind"),
    say: Callable[[str], None] = lambda text: None,
) -> Floor:
    """Run the expert, and the blind plan if `who` names it, on one task, without rendering."""
    from .expert.world import Memory
    from .scene import LiberoScene

    scene = LiberoScene(task, cameras=())
    try:
        known = {"expert": None, "blind": Memory.of(scene, placement) if "blind" in who else None}
        counts, steps, seconds = dict.fromkeys(who, 0), [], 0.0
        for episode in range(episodes):
            for name in who:
                started = time.process_time()
                length = _run(scene, FIRST_SEED + episode, placement, known[name])
                counts[name] += length is not None
                if name == "expert":
                    seconds += time.process_time() - started
                    steps += [length] if length is not None else []
            say(f"{task.key} {placement}: {episode + 1} of {episodes}")
    finally:
        scene.close()
    return Floor(
        task.suite,
        task.index,
        task.name,
        placement,
        episodes,
        counts["expert"],
        counts.get("blind"),
        steps=round(float(np.mean(steps))) if steps else 0,
        seconds=round(seconds / episodes, 1),
    )


def _run(scene: "LiberoScene", seed: int, placement: str, memory: "Memory | None") -> int | None:
    """Steps until an expert (with a memory: a blind plan) reaches the goal, or None."""
    from .expert.expert import Expert

    scene.reset(seed, placement)
    expert = Expert(scene, memory)
    for step in range(scene.task.max_steps):
        if scene.step(expert.act())[1]:
            return step + 1
    return None


def write_floors(floors: list[Floor], path: Path) -> None:
    """Write floors; those in the file that were not measured anew stay."""
    known = read_floors(path) if path.exists() else {}
    known.update({(floor.suite, floor.index, floor.placement): floor for floor in floors})
    entries = [asdict(known[key]) for key in sorted(known)]
    path.write_text("[\n" + ",\n".join(f"  {json.dumps(entry)}" for entry in entries) + "\n]\n")
