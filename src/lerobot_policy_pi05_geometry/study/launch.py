"""Runs of a study, several at once, and over several machines.

Each run is a process with its own threads: at small sizes two processes of one thread do more than one of two. Under
torchrun (or any launcher that sets RANK and WORLD_SIZE) every rank takes its share of the runs; the ranks need nothing of
each other but a folder that all of them see.
"""

import json
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .runs import Run
from .training_log import TrainingCurve
from .worker import PROGRESS

_EVALUATION_COST = 2.5  # of an episode or frame, beside a step of training, for the estimate of the time left
_LAST_WORDS = 2_000  # characters of a crashed run's log that are kept with it


@dataclass
class Job:
    """A run that is being carried out: its process, and how far it is."""

    run: Run
    process: subprocess.Popen
    log_position: int
    curve: TrainingCurve
    stage: str = "start"
    done: int = 0
    total: int = 0

    def read_log(self) -> None:
        """Take note of what the process wrote since the last look."""
        with self.run.log.open() as log:
            log.seek(self.log_position)
            text = log.read()
        complete = text[: text.rfind("\n") + 1]
        self.log_position += len(complete.encode())
        for line in complete.splitlines():
            if self.curve.add(line):
                self.stage, self.done, self.total = "train", self.curve.steps[-1], self.run.steps
            elif PROGRESS in line:
                stage, _, count = line.split(PROGRESS)[1].strip().rpartition(" ")
                self.stage = stage
                self.done, self.total = map(int, count.split("/"))


@dataclass(frozen=True)
class Progress:
    """How far a study is: work done and in all (in training steps), the runs under way, and those that crashed."""

    done: float
    total: float
    jobs: list[Job]
    crashed: list[Run]


def share(runs: Sequence[Run]) -> list[Run]:
    """This process's part of the runs: all of them, or every WORLD_SIZE-th."""
    return list(runs)[int(os.environ.get("RANK", "0")) :: int(os.environ.get("WORLD_SIZE", "1"))]


def default_workers() -> int:
    """Runs at once: one per core, shared with the other ranks on this machine."""
    return max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def launch(
    runs: Sequence[Run], workers: int, on_progress: Callable[[Progress], None], retry_crashed: bool = False
) -> None:
    """Carry out every run that is not complete, `workers` at once.

    A run that crashes is recorded as crashed (`crashed.json` beside its log) and the others go on; it is tried again only
    if `retry_crashed`. Interrupted, this ends its processes; what they had finished is kept.
    """
    waiting = deque(run for run in runs if run.missing() and (retry_crashed or not run.crash.exists()))
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
                    _note_crash(job)
            on_progress(_progress(runs, running))
    finally:
        for job in running:
            job.process.terminate()


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
        environment.pop(name, None)  # a worker trains alone; with these, accelerate would wait for the other ranks
    with run.log.open("a") as log:
        position = log.tell()
        command = [sys.executable, "-m", "lerobot_policy_pi05_geometry.study.worker", str(description)]
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
    return Job(run, process, position, TrainingCurve(run.log_every))


def _note_crash(job: Job) -> None:
    if job.process.returncode == 0:
        return
    last_words = job.run.log.read_text()[-_LAST_WORDS:]
    job.run.crash.write_text(json.dumps({"exit_code": job.process.returncode, "last_words": last_words}, indent=2))


def _progress(runs: Sequence[Run], running: Sequence[Job]) -> Progress:
    crashed = [run for run in runs if run.crash.exists()]
    total = sum(_cost(run, True, run.own_conditions()) for run in runs)
    # A crashed run will not be carried on: the rest of its work is not left to do.
    left = sum(_cost(run, not run.checkpoint.exists(), run.missing()) for run in runs if run not in crashed)
    for job in running:
        if job.stage == "train" and not job.run.checkpoint.exists():
            left -= job.done
        elif job.stage.startswith("evaluate"):
            left -= _EVALUATION_COST * job.done
    return Progress(total - left, total, list(running), crashed)


def _cost(run: Run, training: bool, conditions: Sequence[str]) -> float:
    return training * run.steps + _EVALUATION_COST * len(conditions) * run.evaluation_size
