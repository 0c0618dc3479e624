"""A worker's life."""

import os
import select
import time

import pytest

from lerobot_policy_pi05_geometry.study.worker import end_with_parent


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_a_worker_ends_with_the_process_that_started_it():
    """Parent and worker are forks; the worker holds the pipe's last writing end, so its end is the pipe's end."""
    reading, writing = os.pipe()
    parent = os.fork()
    if parent == 0:
        if os.fork() == 0:
            end_with_parent(poll=0.05)
            os.write(writing, b"started")
            time.sleep(60)
            os._exit(0)
        time.sleep(0.5)
        os._exit(0)  # without a word to the worker
    os.close(writing)
    assert os.read(reading, 10) == b"started"
    os.waitpid(parent, 0)
    assert select.select([reading], [], [], 20)[0]
    assert os.read(reading, 10) == b""
    os.close(reading)
