"""The smallest study, end to end, as a user starts it; then what is made from one of its checkpoints."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from lerobot_policy_pi05_geometry.study.launch import share
from lerobot_policy_pi05_geometry.study.plan import runs_of
from lerobot_policy_pi05_geometry.study.simulated import SimulatedRun
from lerobot_policy_pi05_geometry.study.spec import read_spec
from lerobot_policy_pi05_geometry.study.training_log import read_curve, read_log_line
from tests import commands

pytestmark = [pytest.mark.train, pytest.mark.sim]
CLI = [sys.executable, "-m", "pi05_geometry_cli"]
ENVIRONMENT = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "COLUMNS": "200"}


def command(*arguments: str, code: int = 0, timeout: float = 500) -> str:
    """Run `pi05-geometry` without a hub; returns what it printed."""
    return commands.run("pi05_geometry_cli.__main__", *arguments, code=code, timeout=timeout)


SHORT = """
seeds = [0]
[budget]
variant = "tiny"
episodes = 2
steps = 4
batch_size = 4
image_size = 28
evaluation_episodes = 2
parallel = 2
videos = 0
[[compare]]
tasks = ["button-press-topdown-wide"]
arms = ["blind", "geometry"]
conditions = ["inside"]
"""


def run_of(folder: Path, arm: str) -> SimulatedRun:
    """The run of an arm in the study 'smoke'."""
    return next(run for run in runs_of(read_spec("smoke"), folder) if run.arm_name == arm)


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> str:
    """A study of two runs, shorter than 'smoke'."""
    path = tmp_path_factory.mktemp("spec") / "short.toml"
    path.write_text(SHORT)
    return str(path)


@pytest.fixture(scope="module")
def short_table(short, tmp_path_factory) -> pd.DataFrame:
    """What the short study gives when nothing disturbs it."""
    folder = tmp_path_factory.mktemp("undisturbed")
    command("study", "--spec", short, "--output", str(folder))
    return pd.read_csv(folder / "episodes.csv")


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "study"
    command("study", "--smoke", "--output", str(folder))
    return folder


def test_the_report_holds_every_figure(study):
    page = (study / "report.html").read_text()
    assert page.count("<img ") == 5
    assert page.count("<video ") == 2
    for name in ("success_button-press-topdown-wide", "depth", "layout", "shares", "curves"):
        assert (study / "pictures" / f"{name}.png").stat().st_size > 5_000
    table = pd.read_csv(study / "episodes.csv")
    assert table.equals(pd.read_parquet(study / "episodes.parquet"))
    # arms, training seeds, conditions, episodes; one arm under one condition more, which the others are shown without
    assert len(table) == 3 * 2 * 2 * 2 + 2 * 2
    assert page.count("<td>–</td>") == 2 + 2
    assert table.groupby(["arm", "training_seed", "condition"])["episode_seed"].apply(list).map(str).nunique() == 1


def test_a_run_keeps_its_weights_and_no_state_of_the_optimiser(study):
    for run in runs_of(read_spec("smoke"), study):
        assert (run.checkpoint / "model.safetensors").is_file()
        assert not list(run.folder.rglob("training_state"))


@pytest.mark.long
def test_the_warm_start_study_end_to_end(tmp_path):
    """Every phase as a user starts it: the estimate, the pretraining, two multiples of the steps, the sweep, the report."""
    folder = tmp_path / "warm"
    printed = command("study", "--spec", "warm-start", "--smoke", "--output", str(folder), timeout=3000)
    assert "core-hours" in printed
    assert "azimuth sweep" in printed
    table = pd.read_csv(folder / "episodes.csv")
    assert not table["crashed"].any()
    assert set(table["multiple"]) == {1, 2}
    assert set(table["arm"]) == {"blind", "rgb", "geometry", "rgb-wide", "rgb+rays", "rgb+modulation"}
    swept = table[table["condition"].str.startswith("azimuth")]
    assert set(swept["arm"]) == {"rgb", "geometry", "rgb+modulation"}
    assert (folder / "report.html").read_text().count("<img ") == 3
    printed = command("study", "--spec", "warm-start", "--smoke", "--estimate", "--output", str(folder))
    assert "0.0 core-hours if every arm" in printed


@pytest.mark.long
def test_a_study_killed_at_any_point_gives_the_same_table(short, short_table, tmp_path):
    """Killed with its workers in training, then in evaluation; each time started again in the same folder."""
    runs = runs_of(read_spec(short), tmp_path)
    for reached in (lambda run: (run.folder / "training").exists(), lambda run: run.checkpoint.exists()):
        process = subprocess.Popen(
            [*CLI, "study", "--spec", short, "--output", str(tmp_path)], env=ENVIRONMENT, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        deadline = time.monotonic() + 200
        while not any(map(reached, runs)) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        assert any(map(reached, runs))
        assert not (tmp_path / "report.html").exists()
    command("study", "--spec", short, "--output", str(tmp_path))
    assert pd.read_csv(tmp_path / "episodes.csv").equals(short_table)


def test_what_is_done_is_not_done_again_and_a_crash_is_shown(study, tmp_path):
    """A broken checkpoint crashes its run: the others stand, and its episodes count as failures."""
    folder = tmp_path / "study"
    shutil.copytree(study, folder, symlinks=True)
    broken, whole = run_of(folder, "rgb"), run_of(folder, "geometry")
    before = whole.outcome("outside").stat().st_mtime_ns
    broken.outcome("outside").unlink()
    (broken.checkpoint / "model.safetensors").write_bytes(b"not a checkpoint")
    printed = command("study", "--smoke", "--output", str(folder))
    assert f"Crashed {broken.name}" in printed
    table = pd.read_csv(folder / "episodes.csv")
    crashed = table[table["crashed"]]
    assert set(zip(crashed["arm"], crashed["condition"], strict=True)) == {("rgb", "outside")}
    assert not crashed["success"].any()
    assert "1 crashed" in (folder / "report.html").read_text()
    assert json.loads(broken.crash.read_text())["exit_code"] != 0
    assert whole.outcome("outside").stat().st_mtime_ns == before


def test_a_checkpoint_is_evaluated_and_inspected(study, tmp_path):
    run = run_of(study, "geometry")
    numbers = tmp_path / "numbers.json"
    arguments = ["--episodes", "2", "--image-size", "28", "--cameras", "far", "--sensor", "noisy"]
    printed = command("evaluate", str(run.checkpoint), *arguments, "--output", str(numbers))
    assert "of 2 episodes succeed" in printed
    assert len(json.loads(numbers.read_text())["per_episode"]) == 2
    page = tmp_path / "page.html"
    dataset = f"--dataset.root={run.data_folder}"
    command("inspect", str(run.checkpoint), dataset, "--frame", "3", "--output", str(page))
    assert page.read_text().count("<img ") == 4  # with the scene
    assert "there is no frame 99999" in command("inspect", str(run.checkpoint), dataset, "--frame", "99999", code=1)


@pytest.mark.long
def test_two_ranks_of_torchrun_share_the_runs(short, short_table, tmp_path):
    """Each rank its half, no run twice; the same table as from one process."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m"]
    arguments = [
        "pi05_geometry_cli",
        "study",
        "--spec",
        short,
        "--output",
        str(tmp_path),
        "--workers",
        "1",
    ]
    subprocess.run([*launcher, *arguments], env=ENVIRONMENT, check=True, capture_output=True, timeout=500)
    assert pd.read_csv(tmp_path / "episodes.csv").equals(short_table)
    runs = runs_of(read_spec(short), tmp_path)
    assert [run.log.read_text().count("Start offline training") for run in runs] == [1, 1]


def test_the_ranks_shares_are_a_partition(monkeypatch, tmp_path):
    runs = runs_of(read_spec("default"), tmp_path)
    shares = []
    for rank in range(4):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "4")
        shares += share(runs)
    assert sorted(map(id, shares)) == sorted(map(id, runs))


def test_log_lines_are_read_as_lerobot_writes_them(tmp_path):
    line = "INFO 2026-01-01 10:00:00 ot_train.py:641 step:{} smpl:160 ep:9 epch:0.78 loss:2.063 grdn:6.226 lr:2.4e-05"
    assert read_log_line(line.format("1K")) == {"step": 1000, "loss": 2.063}
    assert read_log_line("INFO 2026-01-01 10:00:00 ot_train.py:687 Checkpoint policy after step 2") is None
    log = tmp_path / "run.log"
    log.write_text("\n".join(line.format(step) for step in (25, 50, 75, 25, 50)))
    assert read_curve(log, 25)["step"] == [25, 50]  # the last start alone
    rounded = [str(step) if step < 1000 else f"{step / 1000:.0f}K" for step in range(25, 1525, 25)]
    log.write_text("\n".join(map(line.format, rounded)))
    assert read_curve(log, 25)["step"] == list(range(25, 1525, 25))  # although LeRobot writes 1K, 1K, ... 2K
