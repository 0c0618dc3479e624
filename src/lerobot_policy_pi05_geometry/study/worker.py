"""Executes one run: prepare, train, evaluate. Finished parts are kept.

It is a separate process, so that a crash affects one run only: `python -m lerobot_policy_pi05_geometry.study.worker RUN PARENT`,
where RUN is a file with the run as JSON, and PARENT the number of the process that started it. Killed at any time and started
again, it gives the same result: each part is written completely or not at all, and training restarts from the same seed. A lock
keeps two processes from executing the same run.
"""

import json
import logging
import os
import sys
import threading
import time
from pathlib import Path

from . import adapted, held_out, pretraining, simulated
from .locks import folder_lock
from .runs import Run

logger = logging.getLogger(__name__)
PROGRESS = "progress:"  # followed by stage and count: "progress: evaluate outside 10/50"
_KINDS = {
    "PretrainingRun": pretraining.from_json,
    "SimulatedRun": simulated.from_json,
    "AdaptedRun": adapted.from_json,
    "HeldOutRun": held_out.from_json,
}


def execute(run: Run) -> None:
    """Execute the missing parts of a run."""
    run.folder.mkdir(parents=True, exist_ok=True)
    run.prepare(_log_progress)
    with folder_lock(run.folder):
        run.train_missing()
        for condition in run.missing():
            run.evaluate(condition, _log_progress)


def end_with_parent(parent: int, poll: float = 1.0) -> None:
    """End this process when the one that started it (its number) has ended, however it did: nobody else would end a run then.

    poll: seconds between two looks.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(poll)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _log_progress(stage: str, done: int, total: int) -> None:
    logger.warning("%s %s %d/%d", PROGRESS, stage, done, total)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    end_with_parent(int(sys.argv[2]))
    content = json.loads(Path(sys.argv[1]).read_text())
    execute(_KINDS[content["kind"]](content))
