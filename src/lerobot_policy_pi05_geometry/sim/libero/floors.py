"""What success on a task is worth: how often its expert succeeds, and how often a plan does that never looks.

`floors.json` has what was measured, by suite, task and placement; a report shows it beside every success rate. Replace it
by running `pi05-geometry libero-floors`.
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .tasks import LiberoTask

FLOORS_FILE = Path(__file__).parent / "floors.json"
FIRST_SEED = 700_000  # apart from evaluation (0) and recording (1,000,000)


@dataclass(frozen=True)
class Floor:
    """Successes of the expert and of the blind plan in `episodes` episodes each, on the same seeds.

    steps: mean length of the expert's successful episodes. seconds: processor time of an expert's episode.
    """

    suite: str
    index: int
    name: str
    placement: str
    episodes: int
    expert: int
    blind: int
    steps: float
    seconds: float

    def __str__(self) -> str:
        return f"blind plan {self.blind}/{self.episodes}, expert {self.expert}/{self.episodes}"


def read_floors(path: Path = FLOORS_FILE) -> dict[tuple[str, int, str], Floor]:
    """The measured floors by (suite, task number, placement)."""
    floors = [Floor(**entry) for entry in json.loads(path.read_text())]
    return {(floor.suite, floor.index, floor.placement): floor for floor in floors}


def measure(task: LiberoTask, placement: str, episodes: int, say: Callable[[str], None] = lambda text: None) -> Floor:
    """Run the expert and the blind plan on one task, without rendering."""
    from .expert.expert import Expert
    from .expert.world import Memory
    from .scene import LiberoScene

    scene = LiberoScene(task, cameras=())
    try:
        memory = Memory.of(scene, placement)
        counts, steps, seconds = {"expert": 0, "blind": 0}, [], 0.0
        for seed in range(FIRST_SEED, FIRST_SEED + episodes):
            for who, known in (("expert", None), ("blind", memory)):
                started = time.process_time()
                scene.reset(seed, placement)
                expert, success = Expert(scene, known), False
                for step in range(task.max_steps):
                    _, success = scene.step(expert.act())
                    if success:
                        break
                counts[who] += success
                if who == "expert":
                    seconds += time.process_time() - started
                    steps += [step + 1] if success else []
            say(f"{task.key} {placement}: {seed - FIRST_SEED + 1} of {episodes}")
    finally:
        scene.close()
    mean = float(np.mean(steps)) if steps else 0.0
    return Floor(
        task.suite, task.index, task.name, placement, episodes, **counts, steps=round(mean), seconds=round(seconds / episodes, 1)
    )


def write_floors(floors: list[Floor], path: Path) -> None:
    """Write floors; those in the file that were not measured anew stay."""
    known = read_floors(path) if path.exists() else {}
    known.update({(floor.suite, floor.index, floor.placement): floor for floor in floors})
    entries = [asdict(known[key]) for key in sorted(known)]
    path.write_text("[\n" + ",\n".join(f"  {json.dumps(entry)}" for entry in entries) + "\n]\n")
