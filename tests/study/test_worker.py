"""A worker's life, and what is read of its log."""

import json
import os
import select
import time
from types import SimpleNamespace

import pytest

from lerobot_policy_pi05_geometry.study.launch import Job, _record_crash
from lerobot_policy_pi05_geometry.study.training_log import TrainingCurve, read_curve
from lerobot_policy_pi05_geometry.study.worker import end_with_parent


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
@pytest.mark.parametrize("early", [False, True])
def test_a_worker_ends_with_the_process_that_started_it(early):
    """Parent and worker are forks; the worker holds the pipe's last writing end, so its end is the pipe's end.

    early: the parent ends before the worker has begun to watch.
    """
    reading, writing = os.pipe()
    parent = os.fork()
    if parent == 0:
        started_by = os.getpid()
        if os.fork() == 0:
            if early:
                time.sleep(0.5)
            os.write(writing, b"started")
            end_with_parent(started_by, poll=0.05)
            time.sleep(60)
            os._exit(0)
        time.sleep(0.1 if early else 0.5)
        os._exit(0)  # without a word to the worker
    os.close(writing)
    assert os.read(reading, 10) == b"started"
    os.waitpid(parent, 0)
    assert select.select([reading], [], [], 20)[0]
    assert os.read(reading, 10) == b""
    os.close(reading)


def test_only_a_whole_line_of_progress_counts(tmp_path):
    """A traceback quotes lines of code such as `for done, _ in progress:`."""
    log = tmp_path / "run.log"
    job = Job(SimpleNamespace(log=log, steps=10), None, 0, TrainingCurve(1))
    log.write_text("WARNING:__main__:progress: record libero_goal/8-near 3/10\nprogress: record libero_goal/8-near 4/")
    job.read_log()
    assert (job.stage, job.done, job.total) == ("record libero_goal/8-near", 3, 10)
    with log.open("a") as file:
        file.write("10\n    for done, _ in progress:\n  File 'progress: a/b'\n")
    job.read_log()
    assert (job.stage, job.done, job.total) == ("record libero_goal/8-near", 4, 10)


def test_a_torn_character_in_a_log_disturbs_nothing(tmp_path):
    """Half of it is written when the log is read, or a library writes in another encoding."""
    log = tmp_path / "run.log"
    run = SimpleNamespace(log=log, steps=10, crash=tmp_path / "crashed.json")
    job = Job(run, SimpleNamespace(returncode=1), 0, TrainingCurve(1))
    first, second = "progress: record π 3/10\n".encode(), "progress: record π 4/10\n".encode()
    torn = first + second[: second.index("π".encode()) + 1]
    log.write_bytes(torn)
    job.read_log()
    assert (job.stage, job.done) == ("record π", 3)
    log.write_bytes(first + second + b"caf\xe9\nprogress: record 5/10\n")
    job.read_log()
    assert (job.stage, job.done, job.log_position) == ("record", 5, log.stat().st_size)
    _record_crash(job)
    assert "record 5/10" in json.loads(run.crash.read_text())["log_end"]
    assert read_curve(log, 1) == {"step": [], "loss": []}
