"""The real openpi-client 0.1.2, in a virtual environment of its own: it needs numpy<2."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_policy_pi05_geometry.serving.engine import PolicyEngine, make_job, note_answer
from lerobot_policy_pi05_geometry.serving.inputs import Inputs
from lerobot_policy_pi05_geometry.serving.limits import Limits
from lerobot_policy_pi05_geometry.serving.service import make_service, make_websocket_server
from lerobot_policy_pi05_geometry.serving.session import Session
from lerobot_policy_pi05_geometry.serving.wire import decode
from tests.entry_points import CHUNK

from .running import load, make_request, serving

pytestmark = pytest.mark.upstream

PACKAGES = ("openpi-client==0.1.2", "numpy<2", "typing_extensions")
KEY = "a-key-of-more-than-sixteen-characters"


@pytest.fixture(scope="module")
def python(tmp_path_factory) -> Path:
    """A Python with openpi-client. Name one that you keep in OPENPI_PYTHON to install it once."""
    if kept := os.environ.get("OPENPI_PYTHON"):
        return Path(kept)
    folder = tmp_path_factory.mktemp("openpi") / "venv"
    found = folder / "bin" / "python"
    # This environment's pip fills it: a new one would have to be installed first, and compiled, as everything.
    pip = [sys.executable, "-m", "pip", f"--python={found}", "install", "--quiet", "--no-compile", *PACKAGES]
    for command in ([sys.executable, "-m", "venv", "--without-pip", str(folder)], pip):
        result = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert result.returncode == 0, result.stderr[-2000:]
    return found


def test_the_real_client(python, tmp_path):
    loaded, requests = load(), [make_request(seed) for seed in range(3)]
    for i, request in enumerate(requests):
        arrays = {"state": request["state"]}
        for outer in ("images", "depth", "extrinsics"):
            arrays |= {f"{outer}/{name}": array for name, array in request[outer].items()}
        np.savez(tmp_path / f"request_{i}.npz", **arrays)
    server = make_websocket_server(make_service(loaded, (1,)), seed=11, key=KEY)
    with serving(server) as running:
        script = Path(__file__).with_name("openpi_process.py")
        result = subprocess.run(
            [str(python), str(script), running.url, KEY, str(tmp_path)],
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr[-3000:]
    told = json.loads((tmp_path / "told.json").read_text())
    assert "401" in told["wrong_key"]
    assert told["metadata"]["chunk_size"] == CHUNK
    assert told["reset"]["episode"] == 1
    assert "has no observation.images.front" in told["mistake"]
    assert told["requests"] == [0] * 4 + [1] * 4  # the broker asks once per horizon
    assert "prev_total_ms" in told["timings"][1]

    def local(session: Session, request: dict) -> np.ndarray:
        """The chunk as the engine computes it here, which test_engine.py shows to be a local run's."""
        read = Inputs(loaded.policy.config, Limits()).read(request)
        (answer,) = engine.run([make_job(session, read, 11, (CHUNK, 8))], 1)
        note_answer(session, read, answer)
        return answer.actions

    engine, session = PolicyEngine(loaded), Session(name=told["metadata"]["session"])
    guidance = {"inference_delay": 1, "executed_steps": 2}
    with np.load(tmp_path / "answers.npz") as answers:
        for request, chunk in zip(requests, answers["chunks"], strict=True):
            np.testing.assert_array_equal(chunk, local(session, request))
        session.reset()
        np.testing.assert_array_equal(answers["guided"][0], local(session, requests[0] | guidance))
        np.testing.assert_array_equal(answers["guided"][1], local(session, requests[1] | guidance))
        session = Session(name=told["broker"])
        steps = np.concatenate([local(session, requests[0])[:4] for _ in range(2)])
        np.testing.assert_array_equal(answers["steps"], steps)
    frame = decode((tmp_path / "frame.bin").read_bytes(), Limits())  # what its packer writes
    np.testing.assert_array_equal(frame["images"]["front"], requests[0]["images"]["front"])
    assert torch.equal(torch.from_numpy(frame["state"].copy()), torch.from_numpy(requests[0]["state"]))
