"""What a user sees of a mistake: one sentence that names it, exit code 1, no traceback."""

import os
import subprocess
import sys

import pytest


def fail(*arguments: str) -> str:
    """Run `pi05-geometry`, which has to fail; returns what it printed."""
    result = subprocess.run(
        [sys.executable, "-m", "lerobot_policy_pi05_geometry.cli", *arguments],
        env=os.environ | {"HF_HUB_OFFLINE": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 1, result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr
    return result.stdout


@pytest.mark.sim
def test_a_task_that_there_is_not(tmp_path):
    assert "There is no simulated task 'fly'" in fail("record", "--output", str(tmp_path / "data"), "--task", "fly")


def test_a_dataset_that_is_none(tmp_path):
    assert "is no LeRobotDataset" in fail("inspect", str(tmp_path), f"--dataset.root={tmp_path}")
