"""What a user sees of a mistake: one sentence that names it, exit code 1, no traceback."""

import json
import os
import shlex
import subprocess
import sys

import pytest
import torch
from typer.testing import CliRunner

from pi05_geometry_cli import app

from .checkpoint.conversion.sources import folder_contents, write_lerobot
from .datasets import write_dataset


def fail(*arguments: str) -> str:
    """Run `pi05-geometry`, which has to fail; returns what it printed."""
    result = subprocess.run(
        [sys.executable, "-m", "pi05_geometry_cli", *arguments],
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


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", "checkpoint"],
        ["bench", "checkpoint"],
        ["scene", "--file", "arm.json"],
        ["calibrate", "camera", "--file", "arm.json", "--camera", "front"],
        ["calibrate", "arm", "--file", "arm.json", "--model", "arm.urdf"],
        ["precompute", "--encoder", "encoder"],
        ["quantiles"],
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_folder_without_a_dataset(arguments, tmp_path, monkeypatch):
    """One sentence, and no look at the hub, where LeRobot would search for it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.LeRobotDatasetMetadata.__init__", None)
    result = CliRunner().invoke(app, [*arguments, f"--dataset.root={tmp_path / 'data'}"])
    assert isinstance(result.exception, FileNotFoundError), result.output
    assert "holds no LeRobotDataset (meta/info.json is missing)" in str(result.exception)


@pytest.mark.parametrize(
    "arguments",
    [
        ["record", "--output", "data", "--episodes", "0"],
        ["record", "--output", "data", "--image-size", "0"],
        ["evaluate", "checkpoint", "--episodes", "0"],
        ["libero-replay", "source", "data", "--image-size", "0"],
        ["precompute", "--batch-size", "0"],
        ["study", "--workers", "0", "--dataset.root", "data"],
    ],
    ids=lambda arguments: " ".join(arguments),
)
def test_a_number_of_nothing_is_refused(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "equal to 1" in result.output
    assert not folder_contents(tmp_path)


@pytest.fixture
def started(monkeypatch):
    """Nothing is trained: the runs that a study would start, and the command that its report would show."""
    seen = {"runs": [], "commands": [], "workers": None}

    def execute(runs, workers, _):
        seen["runs"].extend(runs)
        seen["workers"] = workers

    monkeypatch.setattr("pi05_geometry_cli.studies._execute", execute)
    monkeypatch.setattr("lerobot_policy_pi05_geometry.study.launch.wait_for", lambda _: None)
    for module in ("held_out_report.write_held_out_report", "report.write_report"):
        name = f"lerobot_policy_pi05_geometry.study.{module}"
        monkeypatch.setattr(name, lambda folder, runs, command: seen["commands"].append(command))
    return seen


@pytest.mark.sim
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--dataset.root={}", "--estimate"], "--estimate is an option of a simulated study"),
        (["--dataset.root={}", "--smoke"], "--smoke is an option of a simulated study"),
        (["--dataset.root={}", "--spec", "libero"], "--spec is an option of a simulated study"),
        (["--dataset.root={}", "--seeds=0,x"], "--seeds must be whole numbers with commas between them, got '0,x'"),
        (["--seeds", "0"], "--seeds is not an option of a simulated study"),
        (["--arms=rgb"], "--arms is not an option of a simulated study"),
        (["--steps=10"], "--steps is not an option of a simulated study"),
        (["--pi05", "lerobot/pi05_base"], "--pi05 is not an option of a simulated study"),
        (["--batch_size=8"], "--batch_size=8 is not an option of a simulated study"),
        (
            ["--smoke", "--spec", "missing.toml"],
            "--smoke goes with --spec default or smoke or warm-start, got 'missing.toml'",
        ),
    ],
)
def test_a_study_refuses_the_options_of_the_other_kind(arguments, message, tmp_path, started):
    root = write_dataset(tmp_path / "data")
    result = CliRunner().invoke(
        app, ["study", "--output", str(tmp_path / "out"), *(argument.format(root) for argument in arguments)]
    )
    assert isinstance(result.exception, ValueError), result.output
    assert message in str(result.exception)
    assert not started["runs"]


@pytest.mark.sim
@pytest.mark.parametrize("options", ["--arms rgb --seeds 5,6 --steps 111 --held-out 0.4 --frames 7", "--smoke"])
def test_the_command_that_repeats_a_study_has_every_option(options, tmp_path, started):
    root = write_dataset(tmp_path / "my data")
    own = [] if options == "--smoke" else ["--dataset.root", str(root), "--dataset.repo_id", "me/mine"]
    forwarded = ["--policy.image_resolution=[28, 28]"] if own else []
    arguments = ["study", "--output", str(tmp_path / "out"), *own, *options.split(), *forwarded]
    for _ in range(2):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        assert shlex.split(started["commands"][-1])[0] == "pi05-geometry"
        arguments = shlex.split(started["commands"][-1])[1:]  # repeated as it is shown
    half = len(started["runs"]) // 2
    assert [run.folder for run in started["runs"][:half]] == [run.folder for run in started["runs"][half:]]
    assert started["commands"][0] == started["commands"][1]


@pytest.mark.sim
@pytest.mark.parametrize(
    ("best", "options", "workers"),
    [
        ("cuda", [], 1),
        ("cpu", [], None),
        ("cuda", ["--policy.device=cpu"], None),
        ("cpu", ["--policy.device=cuda"], 1),
        ("cuda", ["--workers", "3"], 3),
    ],
)
def test_an_accelerator_has_one_run_at_once(best, options, workers, tmp_path, started, monkeypatch):
    """Without --policy.device LeRobot takes the best device that there is."""
    monkeypatch.setattr("lerobot.utils.device_utils.auto_select_torch_device", lambda: torch.device(best))
    root = write_dataset(tmp_path / "data")
    arguments = ["--output", str(tmp_path / "out"), f"--dataset.root={root}", "--arms=rgb", *options]
    result = CliRunner().invoke(app, ["study", *arguments])
    assert result.exit_code == 0, result.output
    assert started["workers"] == workers


@pytest.mark.sim
@pytest.mark.parametrize(("device", "workers"), [("cuda", 1), ("cpu", None)])
def test_an_accelerator_has_one_simulated_run_at_once(device, workers, tmp_path, started):
    spec = tmp_path / "spec.toml"
    tables = "[[compare]]\ntasks = ['button-press-wide']\narms = ['rgb']\nconditions = ['inside']"
    spec.write_text(f"seeds = [0]\n[budget]\ndevice = '{device}'\n{tables}\n")
    result = CliRunner().invoke(app, ["study", "--spec", str(spec), "--output", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert started["workers"] == workers


@pytest.mark.sim
def test_ranks_do_not_retry_crashed_runs(tmp_path, started, monkeypatch):
    """A rank could take the crash that another rank is about to retry for the end of that run."""
    monkeypatch.setenv("WORLD_SIZE", "2")
    arguments = ["study", "--smoke", "--output", str(tmp_path / "out"), "--retry-crashed"]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, ValueError), result.output
    assert f"Remove {tmp_path / 'out'}/runs/*/crashed.json" in str(result.exception)
    assert not started["runs"]


def test_a_conversion_that_fails_leaves_nothing(tmp_path):
    """Exit code 1, one sentence, no output."""
    source = write_lerobot(tmp_path / "source", lambda tensors: tensors | {"model.stranger": torch.zeros(2)})
    printed = fail("convert", str(source), str(tmp_path / "output"))
    assert "has unknown tensors: model.stranger; nothing was written" in " ".join(printed.split())
    assert folder_contents(tmp_path) == {"source"}


def test_conversion_and_back(tmp_path):
    source, policy, back = write_lerobot(tmp_path / "source"), tmp_path / "policy", tmp_path / "back"
    options = [
        "--geometry-cameras",
        "front,wrist",
        "--geometry-grid",
        "5",
        "--geometry-gate-openness",
        "0.01",
        "--features-from-data",
    ]
    for arguments in (["convert", str(source), str(policy), *options], ["export", str(policy), str(back)]):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
    config = json.loads((policy / "config.json").read_text())
    assert config["geometry_cameras"] == ["front", "wrist"]
    assert (config["geometry_grid"], config["geometry_gate_openness"], config["input_features"]) == (5, 0.01, {})
    assert json.loads((back / "config.json").read_text())["type"] == "pi05"
    assert "exists already" in fail("export", str(policy), str(back))


@pytest.mark.parametrize("command", [["bench"], ["export"]])
@pytest.mark.parametrize(
    ("setting", "said"),
    [({"of_a_later_version": 1}, "of_a_later_version"), ({"geometry_grid": 0}, "geometry_grid must be at least 1")],
)
def test_settings_that_do_not_fit_are_told_in_one_sentence(command, setting, said, tmp_path):
    policy = tmp_path / "policy"
    arguments = ["convert", str(write_lerobot(tmp_path / "source")), str(policy), "--geometry-source=none"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    config = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps(config | setting))
    result = CliRunner().invoke(
        app, [*command, str(policy), *([str(tmp_path / "out")] if command == ["export"] else [])]
    )
    assert isinstance(result.exception, ValueError)
    assert "do not fit this version of the policy" in str(result.exception)
    assert said in str(result.exception)
