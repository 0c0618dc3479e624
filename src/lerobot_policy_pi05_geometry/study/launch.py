"""Runs of a study: several at once, on one or more machines.

Each run is a process with its own threads: at small sizes two processes of one thread are faster than one of two threads.
Under torchrun (or any launcher that sets RANK and WORLD_SIZE) every rank executes its share of the runs. Ranks share an
output folder and do not communicate otherwise.
"""

import json
import logging
import os
import re
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .runs import Run
from .training_log import TrainingCurve
from .worker import PROGRESS

logger = logging.getLogger(__name__)

_PROGRESS = re.compile(rf"{PROGRESS} (?P<stage>.+) (?P<done>\d+)/(?P<total>\d+)$")
_POLL = 2.0  # seconds between two checks of the shared folder
_EVALUATION_COST = 2.5  # of one episode or frame, in training steps; for the estimate of the remaining time
_CRASH_LOG_CHARACTERS = 2_000  # kept from the end of a crashed run's log


@dataclass
class Job:
    """A run in execution: its process and its progress."""

    run: Run
    process: subprocess.Popen
    log_position: int
    curve: TrainingCurve
    stage: str = "start"
    done: int = 0
    total: int = 0

    def read_log(self) -> None:
        """Update the progress from the lines that the process has logged since the last call."""
        with self.run.log.open("rb") as log:  # positions are of bytes, and a character may be half written
            log.seek(self.log_position)
            content = log.read()
        complete = content[: content.rfind(b"\n") + 1]
        self.log_position += len(complete)
        for line in complete.decode("utf-8", errors="replace").splitlines():
            if self.curve.add(line):
                self.stage, self.done, self.total = "train", self.curve.steps[-1], self.run.steps
            elif (told := _PROGRESS.search(line)) is not None:
                self.stage, self.done, self.total = told["stage"], int(told["done"]), int(told["total"])


@dataclass(frozen=True)
class Progress:
    """Progress of a study: work done and total work (in training steps), running jobs, crashed runs."""

    done: float
    total: float
    jobs: list[Job]
    crashed: list[Run]


def share(runs: Sequence[Run]) -> list[Run]:
    """The runs of this rank: every WORLD_SIZE-th, or all without a launcher."""
    return list(runs)[rank() :: ranks()]


def rank() -> int:
    """This process's rank under a launcher; 0 without one."""
    return int(os.environ.get("RANK", "0"))


def ranks() -> int:
    """The number of ranks under a launcher; 1 without one."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def default_workers() -> int:
    """Runs at once: one per core, divided by the number of ranks on this machine."""
    return max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def launch(
    runs: Sequence[Run], workers: int, on_progress: Callable[[Progress], None], retry_crashed: bool = False
) -> None:
    """Execute every run that is not complete, `workers` at once.

    A run that crashes is recorded (`crashed.json` beside its log) and the others continue. It is tried again only with
    `retry_crashed`. On an interrupt the processes are terminated; finished parts are kept.
    """
    waiting = deque(run for run in runs if not run.complete() and (retry_crashed or not run.crash.exists()))
    threads = max(1, default_workers() // max(1, min(workers, len(waiting))))
    running: list[Job] = []
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_start(waiting.popleft(), threads))
            time.sleep(0.5)
            for job in list(running):
                job.read_log()
                if job.process.poll() is not None:
                    running.remove(job)
                    _record_crash(job)
            on_progress(_progress(runs, running))
    finally:
        for job in running:
            job.process.terminate()


def wait_for(runs: Sequence[Run]) -> None:
    """Wait until other ranks have finished their share of the runs; crashed runs are finished."""
    waiting = [run for run in runs if not _finished(run)]
    if waiting:
        logger.warning("Waiting for %d runs of other ranks.", len(waiting))
    while waiting:
        time.sleep(_POLL)
        waiting = [run for run in waiting if not _finished(run)]


def _finished(run: Run) -> bool:
    return run.crash.exists() or run.complete()


def _start(run: Run, threads: int) -> Job:
    run.folder.mkdir(parents=True, exist_ok=True)
    run.crash.unlink(missing_ok=True)
    description = run.folder / "run.json"
    description.write_text(run.to_json())
    environment = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": str(threads),
        "LP_NUM_THREADS": str(threads),  # Mesa's software renderer
        "TQDM_DISABLE": "1",
        "TOKENIZERS_PARALLELISM": "false",
    }
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        environment.pop(name, None)  # with these set, accelerate would wait for the other ranks
    with run.log.open("a") as log:
        position = log.tell()
        worker = "lerobot_policy_pi05_geometry.study.worker"
        command = [sys.executable, "-m", worker, str(description), str(os.getpid())]
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
    return Job(run, process, position, TrainingCurve(run.log_every))


def _record_crash(job: Job) -> None:
    if job.process.returncode == 0:
        return
    log_end = job.run.log.read_text(encoding="utf-8", errors="replace")[-_CRASH_LOG_CHARACTERS:]
    job.run.crash.write_text(json.dumps({"exit_code": job.process.returncode, "log_end": log_end}, indent=2))


def _progress(runs: Sequence[Run], running: Sequence[Job]) -> Progress:
    crashed = [run for run in runs if run.crash.exists()]
    total = sum(_cost(run, True, run.distinct_conditions()) for run in runs)
    # The remaining work of a crashed run is not done, so it is not counted.
    left = sum(_cost(run, not run.checkpoint.exists(), run.missing()) for run in runs if run not in crashed)
    for job in running:
        if job.stage == "train" and not job.run.checkpoint.exists():
            left -= job.done
        elif job.stage.startswith("evaluate"):
            left -= _EVALUATION_COST * job.done
    return Progress(total - left, total, list(running), crashed)


def _cost(run: Run, training: bool, conditions: Sequence[str]) -> float:
    return training * run.steps + _EVALUATION_COST * len(conditions) * run.evaluation_size
