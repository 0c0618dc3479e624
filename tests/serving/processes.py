"""Checkpoints on disk, and servers and LeRobot's programs as processes of their own."""

import contextlib
import io
import json
import logging
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.entry_points import make_calibration, make_features, make_policy, make_processors, without

REPOSITORY = Path(__file__).parents[2]
PLUGIN = Path(__file__).parent / "plugin"
POSE = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]


def write_checkpoint(folder: Path, **changes: Any) -> Path:
    """A tiny checkpoint of the simulated robot of plugin/: its camera poses are fixed, since LeRobot's loop carries none."""
    inputs, outputs = make_features()
    calibration = make_calibration()
    calibration["wrist"].extrinsics = POSE
    features = {
        "input_features": without(inputs, "observation.calibration.wrist.extrinsics"),
        "output_features": outputs,
    }
    policy = make_policy(**{"calibration": calibration, **features, **changes})
    before, after = make_processors(policy.config)
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return folder


def environment(*paths: Path, **more: str) -> dict[str, str]:
    found = os.environ | {
        "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "COLUMNS": "200", "PYTHONUNBUFFERED": "1",
        "PYTHONPATH": os.pathsep.join(map(str, (*paths, REPOSITORY))),
    }  # fmt: skip
    return found | more


@contextmanager
def server_process(checkpoint: Path, *options: str, log: Path, **env: str) -> Iterator[tuple[int, subprocess.Popen]]:
    """`pi05-geometry serve` on a free port. Yields the port and the process; ends it by SIGTERM, which must work."""
    command = [sys.executable, "-m", "pi05_geometry_cli", "serve", str(checkpoint), *options]
    if "--port" not in options:
        command += ["--port", "0"]
    with log.open("w") as output:
        process = subprocess.Popen(command, env=environment(**env), stdout=output, stderr=subprocess.STDOUT)
        try:
            end = time.monotonic() + 300
            while "Serving" not in log.read_text():
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.1)
            yield int(log.read_text().rsplit(":", 1)[1].split()[0]), process
        finally:
            process.terminate()
            try:
                code = process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
        assert code in (0, -9), log.read_text()


def plugin_path(folder: Path) -> tuple[Path, Path]:
    """Paths that let LeRobot find the simulated robot: its module, and the metadata of a distribution of that name."""
    info = folder / "lerobot_robot_simulated-0.1.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_robot_simulated\nVersion: 0.1\n")
    return PLUGIN, folder


def run(module: str, *options: str, folder: Path, timeout: float = 120, **env: str) -> str:
    """Run one of LeRobot's programs with the simulated robot; returns what it printed."""
    home = {"HF_LEROBOT_HOME": str(folder / "lerobot"), "HOME": str(folder)}
    result = subprocess.run(
        [sys.executable, "-m", module, *options],
        env=environment(*plugin_path(folder / "plugins"), **home, **env),
        cwd=folder, capture_output=True, text=True, timeout=timeout,
    )  # fmt: skip
    assert result.returncode in (0, 1, -2, 130), result.stdout[-3000:] + result.stderr[-6000:]
    return result.stdout + result.stderr


def run_here(module: str, *options: str, folder: Path, timeout: float = 120) -> str:
    """As `run`, within this process, which has imported what takes a new one ten seconds. In the main thread only."""
    root, output = logging.getLogger(), io.StringIO()
    handlers, level = root.handlers[:], root.level
    handled = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
    }
    with pytest.MonkeyPatch.context() as patch:
        for path in plugin_path(folder / "plugins"):
            patch.syspath_prepend(path)
        patch.chdir(folder)  # they write logs there
        patch.setattr(sys, "argv", [module, *options, f"--robot.calibration_dir={folder}"])
        # Whatever a shell or a program that ran here before has made of it: the simulated robot ends programs by it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                runpy.run_module(module, run_name="__main__", alter_sys=True)
        except KeyboardInterrupt:  # how the simulated robot ends a program
            pass
        finally:
            root.handlers[:] = handlers
            root.setLevel(level)
            for number, handler in handled.items():
                signal.signal(number, handler)
    return output.getvalue()


def logged(path: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in path.read_text().splitlines()]
