"""The demo at its smallest size, end to end, as a user starts it; then what is made from its checkpoint."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_policy_pi05_geometry.demo.run import ARMS, CONDITIONS, read_log_line

pytestmark = [pytest.mark.train, pytest.mark.sim]


def command(*arguments: str, code: int = 0) -> str:
    """Run `pi05-geometry` without a hub; returns what it printed."""
    result = subprocess.run(
        [sys.executable, "-m", "lerobot_policy_pi05_geometry.cli", *arguments],
        env=os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert result.returncode == code, result.stdout[-2000:] + result.stderr[-3000:]
    return result.stdout


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "demo"
    command("demo", "--minimal", "--output", str(folder))
    return folder


def test_the_report_holds_every_figure(demo):
    page = (demo / "report.html").read_text()
    assert page.count("<img ") == 5
    assert page.count("<video ") == 2
    for name in ("success", "depth", "layout", "shares", "curves"):
        assert (demo / "pictures" / f"{name}.png").stat().st_size > 5_000
    results = json.loads((demo / "results.json").read_text())
    assert {arm: list(by_condition) for arm, by_condition in results.items()} == {arm: list(CONDITIONS) for arm in ARMS}
    seeds = [[e["seed"] for e in results[arm]["outside"]["per_episode"]] for arm in ARMS]
    assert seeds[0] == seeds[1] == seeds[2] == [0, 1]


def test_an_interrupted_demo_goes_on_where_it_stopped(demo):
    """What is done is not done again; a training that was cut off is."""
    weights = demo / "geometry" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"
    before = weights.stat().st_mtime_ns
    (demo / "report.html").unlink()
    (demo / "evaluation_rgb_outside.npz").unlink()
    shutil.rmtree(demo / "blind" / "checkpoints")
    command("demo", "--minimal", "--output", str(demo))
    assert (demo / "report.html").exists()
    assert (demo / "blind" / "checkpoints" / "last").exists()
    assert weights.stat().st_mtime_ns == before


def test_other_settings_do_not_mix_with_what_is_there(demo):
    assert "other settings" in command("demo", "--output", str(demo), code=1)


def test_a_checkpoint_is_evaluated_and_inspected(demo, tmp_path):
    checkpoint = str(demo / "geometry" / "checkpoints" / "last" / "pretrained_model")
    numbers = tmp_path / "numbers.json"
    arguments = ["--episodes", "2", "--image-size", "28", "--cameras", "far", "--output", str(numbers)]
    assert "of 2 episodes succeed" in command("evaluate", checkpoint, *arguments)
    assert len(json.loads(numbers.read_text())["per_episode"]) == 2
    page = tmp_path / "page.html"
    command("inspect", checkpoint, f"--dataset.root={demo / 'dataset'}", "--frame", "3", "--output", str(page))
    assert page.read_text().count("<img ") == 3
    wrong = command("inspect", checkpoint, f"--dataset.root={demo / 'dataset'}", "--frame", "99999", code=1)
    assert "there is no frame 99999" in wrong


def test_log_lines_are_read_as_lerobot_writes_them():
    line = "INFO 2026-01-01 10:00:00 ot_train.py:641 step:1K smpl:160 ep:9 epch:0.78 loss:2.063 grdn:6.226 lr:2.4e-05"
    assert read_log_line(line) == {"step": 1000, "loss": 2.063}
    assert read_log_line("INFO 2026-01-01 10:00:00 ot_train.py:687 Checkpoint policy after step 2") is None
