"""What the report of a study on own data concludes from errors that are made up."""

from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_train_eval_datasets

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.study import held_out_report
from lerobot_policy_pi05_geometry.study.held_out import held_out_runs
from lerobot_policy_pi05_geometry.study.held_out_report import collect, headline, write_held_out_report
from lerobot_policy_pi05_geometry.study.own_data import Split, split_episodes
from tests.datasets import ACTION_DIM, write_dataset


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "mine")


def test_the_numbers_of_episodes_are_lerobots(tmp_path, caplog):
    """Their share is rounded up for each task, so a task with one episode is not trained on."""
    root = write_dataset(tmp_path / "mine", lengths=(5,) * 6, tasks=("a", "b", "a", "a", "c", "a"))
    (run,) = held_out_runs(tmp_path / "out", root, "local/mine", ["rgb"], [0], {}, 2, 0.2, 3)
    assert run.split == Split(trained=3, held_out=3, untrained=("b", "c"))
    assert run.evaluation_size == 3 * 3
    assert "Every episode of 'b', 'c' is held out" in caplog.text
    config = TrainPipelineConfig(
        dataset=DatasetConfig("local/mine", root=str(root), eval_split=0.2),
        policy=PI05GeometryConfig(device="cpu", push_to_hub=False),
    )
    trained, held_out = make_train_eval_datasets(config)
    assert (trained.num_episodes, held_out.num_episodes) == (run.split.trained, run.split.held_out)
    run.folder.mkdir(parents=True)
    run.log.touch()
    np.savez_compressed(run.outcome("all-cameras"), errors=np.ones((3, 4, ACTION_DIM)))
    page = write_held_out_report(tmp_path / "out", [run], "pi05-geometry study").read_text()
    assert "3 of 6 episodes were held out, the last ones of each task" in page
    assert "no policy was trained on them: b, c." in page
    chosen = {"dataset.episodes": "[1, 4]"}
    assert split_episodes(root, "local/mine", 0.2, {"dataset.episodes": "[0, 2, 4]"}) == Split(1, 2, ("c",))
    with pytest.raises(ValueError, match=r"Of the 2 episodes in .* none is left to train on"):
        held_out_runs(tmp_path / "out", root, "local/mine", ["rgb"], [0], chosen, 2, 0.2, 3)


def test_an_action_that_never_changes_has_no_standard_deviation_to_measure_in(tmp_path, monkeypatch):
    (run,) = executed(write_dataset(tmp_path / "mine"), tmp_path / "out", {("rgb", 0): 0.5}, 3)
    expected = collect([run])["rgb", "all-cameras"].values
    stats = held_out_report.LeRobotDatasetMetadata(run.repo_id, root=run.dataset_root).stats
    moving = stats["action"]["std"].copy()
    assert (moving > 0).all()
    stats["action"]["min"][1] = stats["action"]["max"][1]
    stats["action"]["std"][1] = 1e-12
    monkeypatch.setattr(held_out_report, "LeRobotDatasetMetadata", lambda *_, **__: SimpleNamespace(stats=stats))
    (errors,) = [found.values for found in collect([run]).values()]
    others = np.delete(1 / moving, 1).mean() / (1 / moving).mean()
    np.testing.assert_allclose(errors, expected * others)


def test_the_report_states_all_steps_of_an_arm_after_another_one(tmp_path):
    root = write_dataset(tmp_path / "mine", depth=("observation.images.front_depth",))
    runs = executed(root, tmp_path / "out", {("geometry-after-rgb", 0): 0.5, ("rgb", 0): 0.5}, 3, steps=30)
    assert [run.steps for run in runs] == [15, 30]
    page = write_held_out_report(tmp_path / "out", runs, "pi05-geometry study").read_text()
    assert "2 training runs of 30 steps" in page


def executed(root, output, errors, episodes, crashed=(), steps=2):
    """Runs of two arms without depth; errors: (arm, seed) -> error of each of so many held-out episodes."""
    arms, seeds = (list(dict.fromkeys(names)) for names in zip(*errors, strict=True))
    runs = held_out_runs(output, root, "local/mine", arms, seeds, {}, steps, 0.4, 3)
    for run in runs:
        run.folder.mkdir(parents=True)
        if (run.arm_name, run.seed) in crashed:
            run.crash.write_text("{}")
            continue
        run.log.touch()
        values = np.full((episodes, 4, ACTION_DIM), errors[run.arm_name, run.seed])
        for condition in run.distinct_conditions():
            np.savez_compressed(run.outcome(condition), errors=values + 0.01 * np.arange(episodes)[:, None, None])
    return runs


def as_geometry(errors):
    """The errors, those of the arm `random` as geometry's: this dataset has no depth."""
    return {("geometry" if arm == "random" else arm, condition): of_arm for (arm, condition), of_arm in errors.items()}


def test_arms_are_compared_on_the_training_seeds_that_did_not_crash(root, tmp_path):
    """The error depends on the seed alone, so no arm predicts better, whichever seed each has lost."""
    errors = {(arm, seed): 0.2 + 0.3 * seed for arm in ("rgb", "random") for seed in range(4)}
    runs = executed(root, tmp_path, errors, 3, crashed=[("rgb", 0), ("random", 3)])
    found = as_geometry(collect(runs))
    assert found["geometry", "all-cameras"].seeds == (0, 1, 2)
    assert "no significant difference (+0.000, +0.000 to +0.000)." in headline(found)
    runs = executed(root, tmp_path / "none", errors, 3, crashed=[("rgb", 0), ("rgb", 1), ("random", 2), ("random", 3)])
    assert "no training seed in common" in headline(as_geometry(collect(runs)))


def test_one_held_out_episode_or_one_seed_is_named(root, tmp_path):
    errors = {("rgb", 0): 0.5, ("random", 0): 0.499}
    runs = executed(root, tmp_path / "one", errors, 1)
    found = headline(as_geometry(collect(runs)))
    assert "On the one held-out episode" in found
    assert "predicts" not in found
    page = write_held_out_report(tmp_path / "one", runs, "pi05-geometry study").read_text()
    assert "of one held-out episode there is no interval" in page
    assert " to " not in page[page.index("<td>rgb") : page.index("</table>")]
    runs = executed(root, tmp_path / "two", errors, 2)
    assert "geometry predicts better" in headline(as_geometry(collect(runs)))
    assert headline(as_geometry(collect(runs))).endswith("leaves out how much training seeds differ.")
    more = executed(root, tmp_path / "seeds", {(arm, seed): 0.5 for arm in ("rgb", "random") for seed in (0, 1)}, 2)
    assert "training seeds differ" not in headline(as_geometry(collect(more)))
