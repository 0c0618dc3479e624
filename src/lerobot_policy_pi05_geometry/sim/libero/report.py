"""lerobot-eval's outcome on LIBERO as a table: success per task with its interval, beside the task's floor."""

import json
from dataclasses import dataclass
from pathlib import Path

from scipy.stats import binomtest

from .floors import FLOORS_FILE, Floor, read_floors
from .tasks import PLACEMENTS

EVAL_INFO = "eval_info.json"
CONFIDENCE = 0.95


@dataclass(frozen=True)
class TaskResult:
    """Episodes of one task, and its floor under the same placement; None where none was measured."""

    suite: str
    index: int
    successes: int
    episodes: int
    floor: Floor | None

    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the success rate."""
        return wilson(self.successes, self.episodes)


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """95 % Wilson interval of a success rate."""
    interval = binomtest(successes, episodes).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def read_results(folder: Path, placement: str, floors_file: Path = FLOORS_FILE) -> list[TaskResult]:
    """Results per task of a folder that lerobot-eval wrote, with the floors of a file that `libero-floors` wrote.

    Raises FileNotFoundError or ValueError in one sentence.
    """
    if placement not in PLACEMENTS:
        raise ValueError(f"There is no placement '{placement}'; choose one of: {', '.join(PLACEMENTS)}.")
    file = Path(folder) / EVAL_INFO
    if not file.is_file():
        raise FileNotFoundError(f"{file} is not there; give the --output_dir of a lerobot-eval that has ended.")
    content = json.loads(file.read_text())
    floors, results = read_floors(floors_file), []
    try:
        for entry in content["per_task"]:
            suite, index, successes = entry["task_group"], int(entry["task_id"]), entry["metrics"]["successes"]
            floor = floors.get((suite, index, placement))
            results.append(TaskResult(suite, index, sum(map(bool, successes)), len(successes), floor))
    except (KeyError, TypeError) as error:
        raise ValueError(f"{file} is no outcome of LeRobot 0.6's lerobot-eval: {error} is missing.") from error
    return sorted(results, key=lambda result: (result.suite, result.index))


def report(results: list[TaskResult], placement: str) -> str:
    """A Markdown table of the results, with a row per suite."""
    lines = [
        f"Placement of objects: `{placement}`. Intervals are 95 % Wilson intervals. The blind plan knows the mean places of",
        "all objects and never looks: what does not exceed it does not show that the policy sees.",
        "",
        "| task | success | 95 % interval | blind plan | expert |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [_row(f"{r.suite}/{r.index}", r.successes, r.episodes, *_floor_columns(r.floor)) for r in results]
    for suite in dict.fromkeys(result.suite for result in results):
        own = [result for result in results if result.suite == suite]
        lines.append(_row(f"**{suite}**", sum(r.successes for r in own), sum(r.episodes for r in own), "", ""))
    return "\n".join(lines) + "\n"


def _row(name: str, successes: int, episodes: int, blind: str, expert: str) -> str:
    low, high = wilson(successes, episodes)
    return f"| {name} | {successes}/{episodes} | {low:.0%} to {high:.0%} | {blind} | {expert} |"


def _floor_columns(floor: Floor | None) -> tuple[str, str]:
    return ("not measured", "not measured") if floor is None else (floor.blind_share, floor.expert_share)
