"""A warm start at the smallest size: pretrained, exported, converted, fine-tuned, adapted, evaluated."""

import dataclasses

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.geometry.dataset_calibration import read_dataset_calibration
from lerobot_policy_pi05_geometry.study.arms import ARMS
from lerobot_policy_pi05_geometry.study.frames_in_memory import FramesInMemory
from lerobot_policy_pi05_geometry.study.plan import runs_of
from lerobot_policy_pi05_geometry.study.spec import Budget, Comparison, Pretraining, StudySpec
from lerobot_policy_pi05_geometry.study.warm_start import make_start, remaining_options
from lerobot_policy_pi05_geometry.study.worker import execute

pytestmark = [pytest.mark.train, pytest.mark.sim]

TASK = "button-press-topdown-wide"
SPEC = StudySpec(
    seeds=(0,),
    comparisons=(Comparison((TASK,), ("rgb", "rgb+rays", "rgb+modulation"), ("inside",)),),
    budget=Budget(
        "tiny", episodes=1, steps=2, batch_size=2, flow_samples=1, image_size=28, evaluation_episodes=1, parallel=1,
        videos=0, adaptation_steps=2,
    ),
    pretraining=Pretraining(("faucet-open-wide", "handle-press-wide"), episodes=1, steps=2),
)  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs by arm, all of them executed in this process, and the pretraining."""
    found = {run.arm_name: run for run in runs_of(SPEC, tmp_path_factory.mktemp("study"))}
    origin = found["rgb"].origin
    execute(origin)
    for run in found.values():
        execute(run)
    return found | {"pretraining": origin}


def test_every_run_is_complete_and_is_not_repeated(runs):
    assert all(run.complete() for run in runs.values())
    run = runs["rgb+rays"]
    before = (run.checkpoint / "model.safetensors").stat().st_mtime_ns
    execute(run)
    assert (run.checkpoint / "model.safetensors").stat().st_mtime_ns == before


def test_pretraining_data_are_the_episodes_of_its_tasks(runs):
    """Frame by frame, except for the numbering; with quantiles over all frames."""
    origin = runs["pretraining"]
    deltas = {"action": [step / 20 for step in range(4)]}
    merged = FramesInMemory(LeRobotDataset("local/pretraining", root=origin.data_folder, delta_timestamps=deltas))
    start = 0
    for recording in origin.recordings:
        own = FramesInMemory(LeRobotDataset(recording.repo_id, root=recording.folder, delta_timestamps=deltas))
        for index in range(len(own)):
            found, expected = merged[start + index], own[index]
            for key in expected.keys() - {"index", "episode_index", "task_index"}:
                same = found[key] == expected[key]
                assert same.all() if isinstance(same, torch.Tensor) else same, (recording.task, index, key)
        start += len(own)
    assert len(merged) == start
    calibrations = [
        read_dataset_calibration(LeRobotDatasetMetadata("local/any", root=folder), {})
        for folder in (origin.data_folder, origin.recordings[0].folder)
    ]
    assert calibrations[0] == calibrations[1] != {}


def test_every_arm_starts_from_the_pretrained_weights(runs):
    """The conversion keeps them bit for bit; the new parameters are the arm's own; training moves on from there."""
    pretrained = load_file(runs["pretraining"].checkpoint / "model.safetensors")
    for arm in ("rgb", "rgb+rays"):
        start = load_file(runs[arm].start / "model.safetensors")
        shared = start.keys() & pretrained.keys() - {"progress.step"}
        assert len(shared) > 50
        assert all(torch.equal(start[name], pretrained[name]) for name in shared)
        trained = load_file(runs[arm].checkpoint / "model.safetensors")
        assert any(not torch.equal(trained[name], start[name]) for name in shared)
    config = PreTrainedConfig.from_pretrained(runs["rgb+rays"].checkpoint)
    assert config.geometry_source == "rays"
    assert list(config.calibration) == ["front"]
    assert config.geometry_pending == 0


def test_an_adapted_arm_trains_nothing_of_its_own(runs):
    run = runs["rgb+modulation"]
    assert run.checkpoint == runs["rgb"].checkpoint
    assert not (run.folder / "trained").exists()
    assert run.demonstration("inside").folder.exists()
    assert run.demonstration("inside").description() != run.recording.description()
    untrained = dataclasses.replace(run, seed=7)
    with pytest.raises(FileNotFoundError, match="has not been trained"):
        untrained.prepare(lambda *_: None)


def test_an_arm_goes_on_from_the_policy_of_another_one(runs):
    """Converted with everything that it has learnt; a run whose first half is missing is refused."""
    rgb = runs["rgb"]
    run = dataclasses.replace(rgb, arm_name="geometry-after-rgb", multiple=2)
    assert (run.before.folder, run.steps) == (rgb.folder, 2)
    execute(run)
    first, start = (load_file(folder / "model.safetensors") for folder in (rgb.checkpoint, run.start))
    assert all(torch.equal(start[name], values) for name, values in first.items() if name != "progress.step")
    added = start.keys() - first.keys()
    assert all(name.startswith(("geometry.adapter.", "model.paligemma_with_expert.geometry_gate.")) for name in added)
    assert added
    trained = load_file(run.checkpoint / "model.safetensors")
    assert trained.keys() == start.keys()
    assert any(not torch.equal(trained[name], start[name]) for name in first)
    config = PreTrainedConfig.from_pretrained(run.checkpoint)
    assert (config.geometry_source, config.image_dropout, config.geometry_dropout) == ("rgbd", 0.4, 0.2)
    with pytest.raises(FileNotFoundError, match=r"goes on from run .*-rgb-0-x2, which has not been trained"):
        dataclasses.replace(run, multiple=4).prepare(lambda *_: None)


@pytest.mark.parametrize("arm", ["grid-4", "pooled"])
def test_what_defines_new_weights_is_decided_by_the_conversion(arm, runs, tmp_path):
    make_start(runs["pretraining"].pi05, tmp_path / "start", ARMS[arm].options, ("front",), seed=0)
    config = PreTrainedConfig.from_pretrained(tmp_path / "start")
    given = {name.removeprefix("policy."): value for name, value in ARMS[arm].options.items()}
    assert {name: str(getattr(config, name)) for name in given} == given
    assert remaining_options(ARMS[arm].options) == {}
