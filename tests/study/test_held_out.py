"""A study on a user's own dataset: what is held out, what is compared, and what comes out."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy
from lerobot_policy_pi05_geometry.geometry.calibration import Rig, write_calibration_file
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.sim.record import record
from lerobot_policy_pi05_geometry.study.held_out import (
    ALL_CAMERAS,
    NO_DEPTH,
    ONLY,
    action_errors,
    held_out_runs,
    hide_depth,
    view_conditions,
)
from lerobot_policy_pi05_geometry.study.own_data import geometry_cameras
from lerobot_policy_pi05_geometry.study.warm_start import geometry_start
from tests import commands
from tests.checkpoint.conversion.sources import write_lerobot
from tests.datasets import write_dataset

pytestmark = pytest.mark.sim
_WEIGHTS = "trained/checkpoints/last/pretrained_model/model.safetensors"
OPTIONS = {"policy.device": "cpu", "policy.n_action_steps": "4", "batch_size": "4"}
FRONT_DEPTH, WRIST_DEPTH = "observation.images.front_depth", "observation.images.wrist_depth"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A dataset of five short episodes."""
    folder = tmp_path_factory.mktemp("data") / "mine"
    for _ in record(folder, "local/mine", "button-press-topdown-wide", episodes=5, image_size=28):
        pass
    return folder


def test_errors_are_those_of_the_frames_that_are_there(root):
    """A policy that always predicts zero is off by the mean size of the recorded actions; padding does not count."""
    chunk = 6
    deltas = {"action": [i / 20 for i in range(chunk)]}
    dataset = LeRobotDataset("local/mine", root=root, episodes=[3, 4], delta_timestamps=deltas)
    config = SimpleNamespace(chunk_size=chunk, max_action_dim=4, device="cpu", depth_keys={})
    nothing = SimpleNamespace(
        config=config, reset=lambda: None, predict_action_chunk=lambda batch, noise: torch.zeros_like(noise)
    )
    loaded = LoadedPolicy(nothing, preprocess=lambda batch: batch, postprocess=lambda step: step)
    frames = 7
    errors = action_errors(loaded, dataset, ALL_CAMERAS, frames)
    episode_of = np.array(dataset.hf_dataset["episode_index"])
    actions = np.stack(dataset.hf_dataset["action"])
    for e, episode in enumerate((3, 4)):
        own = np.abs(actions[episode_of == episode])
        chosen = np.unique(np.linspace(0, len(own) - 1, frames).astype(int))
        for step in range(chunk):
            there = [own[i + step] for i in chosen if i + step < len(own)]
            np.testing.assert_allclose(errors[e, step], np.mean(there, axis=0), rtol=1e-5)


def test_hidden_depth_measures_nothing_and_the_rest_stays():
    batch = {
        FRONT_DEPTH: torch.ones(2, 1, 3, 3),
        WRIST_DEPTH: torch.ones(2, 1, 3, 3),
        "observation.state": torch.ones(2),
    }
    for condition, front, wrist in ((ALL_CAMERAS, 1, 1), (NO_DEPTH, 0, 0), (f"{ONLY}front", 1, 0)):
        shown = hide_depth(batch, condition, {})
        assert (shown[FRONT_DEPTH] == front).all(), condition
        assert (shown[WRIST_DEPTH] == wrist).all(), condition
        assert shown["observation.state"] is batch["observation.state"]
    assert (batch[FRONT_DEPTH] == 1).all()


def test_a_colour_image_that_is_named_as_depth_stays():
    batch = {FRONT_DEPTH: torch.ones(2, 1, 4, 4), "observation.images.side_depth": torch.ones(2, 3, 4, 4)}
    shown = hide_depth(batch, NO_DEPTH, {})
    assert not shown[FRONT_DEPTH].any()
    assert shown["observation.images.side_depth"].all()


def test_what_cannot_be_studied_is_named(root, tmp_path):
    def runs(folder=root, arms=("geometry",), held_out=0.2, seeds=(0,), steps=4, frames=3, **options):
        return held_out_runs(tmp_path, folder, "local/mine", arms, seeds, options, steps, held_out, frames)

    assert view_conditions(root, "local/mine") == [ALL_CAMERAS, NO_DEPTH]
    assert runs()[0].distinct_conditions() == [ALL_CAMERAS, NO_DEPTH]
    assert runs(arms=("rgb",))[0].distinct_conditions() == [ALL_CAMERAS]
    with pytest.raises(FileNotFoundError, match="holds no LeRobotDataset"):
        runs(folder=tmp_path)
    with pytest.raises(ValueError, match="only the simulator has"):
        runs(arms=("rgb-wide",))
    with pytest.raises(ValueError, match="half of its steps from arm 'rgb', so --steps must be at least 2"):
        runs(arms=("rgb", "geometry-after-rgb"), steps=1)
    with pytest.raises(ValueError, match="between 0 and 1"):
        runs(held_out=1.0)
    with pytest.raises(ValueError, match="--seeds must name at least one of them, and each once, got 0, 0"):
        runs(seeds=(0, 0))
    with pytest.raises(ValueError, match="--arms must name at least one of them, and each once, got rgb, rgb"):
        runs(arms=("rgb", "rgb"))
    with pytest.raises(ValueError, match=r"leave --dataset.streaming out"):
        runs(**{"dataset.streaming": "true"})
    for name in ("frames", "steps"):
        with pytest.raises(ValueError, match=f"--{name} must be at least 1, got 0"):
            runs(**{name: 0})


def test_only_arms_that_measure_depth_get_its_augmentation(root, tmp_path):
    options = {f"policy.depth_augmentation.{name}": "0.01" for name in ("noise", "shift")}
    kept = {"geometry": {"noise", "shift"}, "camera-frame": {"noise"}, "rgb": set(), "random": set(), "blind": set()}
    for run in held_out_runs(tmp_path, root, "local/mine", list(kept), [0], options, 4, 0.2, 3):
        given = [a for a in run.arguments(tmp_path / "run", tmp_path / "start") if "depth_augmentation" in a]
        assert {a.partition("=")[0].rpartition(".")[2] for a in given} == kept[run.arm_name]


@pytest.mark.train
def test_a_study_of_a_dataset_end_to_end(root, tmp_path):
    arguments = [
        "study", f"--dataset.root={root}", "--output", str(tmp_path), "--arms=blind,geometry,geometry-after-rgb",
        "--seeds=0", "--steps=3", "--held-out=0.4", "--frames=3", "--policy.device=cpu", "--policy.paligemma_variant=tiny",
        "--policy.action_expert_variant=tiny", "--policy.image_resolution=[28, 28]", "--policy.chunk_size=4",
        "--policy.n_action_steps=4", "--batch_size=4",
    ]  # fmt: skip
    commands.run("pi05_geometry_cli.__main__", *arguments)
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img ") == 2
    assert "open-loop error, not success" in page
    table = pd.read_csv(tmp_path / "errors.csv")
    views = table.groupby("arm")["condition"].unique().map(set).to_dict()
    both = {ALL_CAMERAS, NO_DEPTH}
    assert views == {"blind": {ALL_CAMERAS}, "geometry": both, "geometry-after-rgb": both}
    assert set(table["episode"]) == {0, 1}  # two of five are held out
    assert len(table) == (1 + 2 + 2) * 2 * 4 * 4  # views, episodes, steps ahead, dimensions
    geometry = table[table["arm"] == "geometry"].set_index("condition")["error"]
    assert not np.allclose(geometry[ALL_CAMERAS], geometry[NO_DEPTH])
    steps = {
        arm: sorted(
            int(load_file(file)["progress.step"]) for file in (tmp_path / "runs").glob(f"mine-{arm}-0-*/{_WEIGHTS}")
        )
        for arm in ("rgb", "geometry-after-rgb")
    }
    # One step with RGB only, in a run of its own, and two more.
    assert steps == {"rgb": [1], "geometry-after-rgb": [3]}


@pytest.mark.train
def test_every_arm_can_start_from_a_pi05(root, tmp_path):
    """It is converted for each arm, as a user does it, and the conversion is gone afterwards."""
    pi05, output = write_lerobot(tmp_path / "pi05"), tmp_path / "study"
    arguments = [
        "study", f"--dataset.root={root}", "--output", str(output), "--pi05", str(pi05), "--arms=rgb,geometry", "--seeds=0",
        "--steps=2", "--held-out=0.4", "--frames=3", "--policy.device=cpu", "--policy.n_action_steps=4", "--batch_size=4",
    ]  # fmt: skip
    commands.run("pi05_geometry_cli.__main__", *arguments)
    assert f"--pi05 {pi05}" in (output / "report.html").read_text()
    weights = load_file(pi05 / "model.safetensors")
    for run in held_out_runs(output, root, "local/dataset", ["rgb", "geometry"], [0], OPTIONS, 2, 0.4, 3, str(pi05)):
        assert not run.missing()
        assert not run.start.exists()
        trained = load_file(run.checkpoint / "model.safetensors")
        frozen = "model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
        assert (trained[frozen] - weights[frozen].float()).abs().max() < 1e-2  # two small steps from where it began
        assert any("geometry" in name for name in trained) == (run.arm_name == "geometry")


def test_an_own_grid_is_converted_to_and_not_given_twice(root, tmp_path):
    (run,) = held_out_runs(
        tmp_path, root, "local/mine", ["geometry"], [0], {"policy.geometry_grid": "4"}, 2, 0.4, 3, "pi05"
    )
    assert not any("geometry_grid" in argument for argument in run.arguments(tmp_path, tmp_path))
    assert geometry_start(run._options(), ["front"]).grid == 4
    other = replace(run, pi05="another")
    assert other.folder != run.folder != replace(run, pi05=None).folder


def test_a_study_that_keeps_no_checkpoint_is_refused(root, tmp_path):
    with pytest.raises(ValueError, match="leave --save_checkpoint out"):
        held_out_runs(tmp_path, root, "local/mine", ["rgb"], [0], {"save_checkpoint": "false"}, 2, 0.4, 3)


def test_an_arm_that_a_conversion_undoes_is_refused(root, tmp_path):
    for arm in ("prefix", "gate-closed", "parallel"):
        with pytest.raises(ValueError, match=f"'{arm}' is for policies trained from scratch"):
            held_out_runs(tmp_path, root, "local/mine", [arm], [0], {}, 2, 0.4, 3, "pi05")
        assert held_out_runs(tmp_path, root, "local/mine", [arm], [0], {}, 2, 0.4, 3)


def test_a_pi05_that_was_trained_on_is_another_one(root, tmp_path):
    pi05 = tmp_path / "pi05"
    pi05.mkdir()
    folders = []
    for content in ("one", "two, longer"):
        (pi05 / "model.safetensors").write_text(content)
        (run,) = held_out_runs(tmp_path, root, "local/mine", ["geometry"], [0], {}, 2, 0.4, 3, str(pi05))
        folders.append(run.folder)
    assert folders[0] != folders[1]


def test_a_run_is_another_one_when_its_data_or_its_calibration_change(tmp_path):
    """By content: a file that was only written again is the same."""
    root, calibration = write_dataset(tmp_path / "data"), tmp_path / "calibration.json"
    calibration.write_text("one")
    options = {"policy.calibration_path": str(calibration)}

    def folder():
        return held_out_runs(tmp_path / "out", root, "local/mine", ["rgb"], [0], options, 2, 0.4, 3)[0].folder

    before = folder()
    os.utime(next((root / "data").rglob("*.parquet")))
    assert folder() == before
    seen = {before}
    tasks = root / "meta" / "tasks.parquet"
    for change in (
        lambda: calibration.write_text("two"),
        lambda: (root / "meta" / "calibration.json").write_text("two"),
        lambda: pd.read_parquet(tasks).rename(index={"push": "pull"}).to_parquet(tasks),
    ):
        change()
        assert folder() not in seen
        seen.add(folder())
    data = next((root / "data").rglob("*.parquet"))
    data.write_bytes(data.read_bytes()[::-1])
    assert folder() not in seen


def write_depth(root, front):
    """Five episodes with depth of two cameras, and their calibration. front: key of the front camera's depth."""
    write_dataset(root, lengths=(6,) * 5, depth=(front, WRIST_DEPTH))
    cameras = {
        name: CameraCalibration([30.0, 30.0, 13.5, 13.5], [28, 28], np.eye(4).tolist()) for name in ("front", "wrist")
    }
    write_calibration_file(root / "meta" / "calibration.json", Rig(cameras))
    return root


def test_the_cameras_of_a_study_are_those_of_its_options(tmp_path):
    """The front camera's depth has another name than LeRobot's, and not its flag."""
    root, keys = write_depth(tmp_path / "data", "observation.images.range"), '{"front": "observation.images.range"}'

    def views(**options):
        return view_conditions(root, "local/mine", {f"policy.{name}": value for name, value in options.items()})

    assert views() == [ALL_CAMERAS, NO_DEPTH]
    assert views(depth_keys=keys) == [ALL_CAMERAS, f"{ONLY}front", f"{ONLY}wrist", NO_DEPTH]
    assert views(depth_keys=keys, geometry_cameras='["front"]') == [ALL_CAMERAS, NO_DEPTH]
    with pytest.raises(ValueError, match="geometry_cameras names side, but the data has depth from wrist only"):
        views(geometry_cameras="[side]")
    with pytest.raises(ValueError, match="A setting of the policy cannot be read"):
        views(geometry_cameras="{3")
    rays = {"policy.geometry_source": "rays", "policy.depth_keys": keys}
    assert geometry_cameras(root, "local/mine", rays) == ["front", "wrist"]
    assert geometry_cameras(root, "local/mine", rays | {"policy.geometry_cameras": "[wrist]"}) == ["wrist"]


@pytest.mark.train
def test_a_pi05_is_converted_for_the_cameras_of_the_options(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["train"])  # training sets them
    root, pi05 = write_depth(tmp_path / "data", FRONT_DEPTH), write_lerobot(tmp_path / "pi05")
    options = {**OPTIONS, "policy.geometry_cameras": '["front"]'}
    (run,) = held_out_runs(tmp_path / "out", root, "local/mine", ["geometry"], [0], options, 2, 0.4, 3, str(pi05))
    run.folder.mkdir(parents=True)
    run.prepare(lambda *_: None)
    run.train(tmp_path / "training")
    config = json.loads((tmp_path / "training/checkpoints/last/pretrained_model/config.json").read_text())
    assert (config["geometry_cameras"], config["geometry_pending"]) == (["front"], 0)
