"""Carries out one run: prepare, train, evaluate. Whatever is there already is kept.

A process of its own, so that a crash takes nothing with it: `python -m lerobot_policy_pi05_geometry.study.worker RUN`, where
RUN is the run as JSON. Killed at any point and started again, it gives the same result: every step appears whole or not
at all, and training starts anew from the same seed. Two processes on the same run wait for each other.
"""

import json
import logging
import shutil
import sys
from pathlib import Path

from . import held_out, simulated
from .locks import alone
from .runs import Run

logger = logging.getLogger(__name__)
PROGRESS = "progress:"  # then what is being done, and how far: "progress: evaluate outside 10/50"
_KINDS = {"SimulatedRun": simulated.from_json, "HeldOutRun": held_out.from_json}


def carry_out(run: Run) -> None:
    """Do what is missing of a run."""
    run.folder.mkdir(parents=True, exist_ok=True)
    run.prepare(_say)
    with alone(run.folder):
        if not run.checkpoint.exists():
            output = run.folder / "training"
            shutil.rmtree(output, ignore_errors=True)  # what is left of a training that was cut off
            run.train(output)
            output.rename(run.folder / "trained")
        for condition in run.missing():
            run.evaluate(condition, _say)


def _say(what: str, done: int, total: int) -> None:
    logger.warning("%s %s %d/%d", PROGRESS, what, done, total)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    content = json.loads(Path(sys.argv[1]).read_text())
    carry_out(_KINDS[content["kind"]](content))
