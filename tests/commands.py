"""Commands as processes of their own that do not each import PyTorch and LeRobot, which takes seconds of a processor's time.

One process per test session imports them; every command is a fork of it (Python's forkserver), with its own arguments,
environment and output.
"""

import importlib
import multiprocessing
import os
import sys
import tempfile

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(
    [
        "lerobot.scripts.lerobot_train",
        "lerobot.scripts.lerobot_eval",
        "lerobot_policy_pi05_geometry.modeling_pi05_geometry",
    ]
)
SETTINGS = {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl", "COLUMNS": "200"}


def run(module: str, *arguments: str, code: int = 0, timeout: float = 500, **environment: str) -> str:
    """Run `python -m module arguments` without a hub, expecting the exit code; returns what it wrote."""
    with tempfile.NamedTemporaryFile("r", suffix=".log") as log:
        process = _SERVER.Process(target=_main, args=(module, arguments, SETTINGS | environment, log.name))
        process.start()
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
        written = log.read()
    assert process.exitcode == code, f"exit code {process.exitcode}\n{written[-5000:]}"
    return written


def _main(module: str, arguments: tuple[str, ...], environment: dict[str, str], log: str) -> None:
    os.environ.update(environment)
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.argv = [module, *arguments]
    importlib.import_module(module).main()
