"""What a study file may say, what it means, and what it is told when it says something else."""

import dataclasses
import json

import pytest

from lerobot_policy_pi05_geometry.study.arms import ARMS
from lerobot_policy_pi05_geometry.study.conditions import CONDITIONS, equivalent_condition
from lerobot_policy_pi05_geometry.study.simulated import from_json, runs_of
from lerobot_policy_pi05_geometry.study.spec import STUDIES, Budget, read_spec

pytestmark = pytest.mark.sim
SPEC = """
seeds = [3, 4]
[budget]
steps = 7
[[compare]]
tasks = ["button-press-topdown-wide"]
arms = ["rgb", "geometry"]
conditions = ["inside", "noise"]
"""


def write(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def test_a_file_becomes_runs(tmp_path):
    runs = runs_of(read_spec(write(tmp_path, SPEC)), tmp_path)
    assert [(run.arm_name, run.seed) for run in runs] == [("rgb", 3), ("geometry", 3), ("rgb", 4), ("geometry", 4)]
    assert {run.budget for run in runs} == {dataclasses.replace(Budget(), steps=7)}
    assert from_json(json.loads(runs[1].to_json())) == runs[1]


@pytest.mark.parametrize("name", sorted(path.stem for path in STUDIES.glob("*.toml")))
def test_every_study_that_comes_along_can_be_read(name):
    assert read_spec(name).comparisons


def test_the_default_study_is_the_one_that_was_promised(tmp_path):
    """Every arm on one task, the rivals on two more, under every condition that concerns them."""
    spec = read_spec("default")
    assert len(spec.seeds) >= 3
    assert spec.budget.evaluation_episodes >= 50
    conditions = {(run.task, run.arm_name): set(run.conditions) for run in runs_of(spec, tmp_path)}
    arms = {task: {arm for t, arm in conditions if t == task} for task, _ in conditions}
    assert max(arms.values(), key=len) == set(ARMS)
    assert len(arms) >= 3
    for task, on_task in arms.items():
        assert {"blind", "rgb", "rgb-wide", "geometry"} <= on_task
        assert conditions[task, "geometry"] == set(CONDITIONS) - {"far"}
        assert all({"inside", "outside"} <= conditions[task, arm] for arm in on_task)


def test_what_several_blocks_ask_of_an_arm_adds_up(tmp_path):
    text = (
        SPEC
        + '[[compare]]\ntasks = ["button-press-topdown-wide"]\narms = ["geometry", "blind"]\nconditions = ["far", "inside"]\n'
    )
    runs = [run for run in runs_of(read_spec(write(tmp_path, text)), tmp_path) if run.seed == 3]
    asked = [(run.arm_name, run.conditions) for run in runs]
    own = runs_of(read_spec(write(tmp_path, SPEC)), tmp_path)[0].conditions
    assert asked == [
        ("rgb", own),
        ("geometry", (*own, *(c for c in ("far", "inside") if c not in own))),
        ("blind", ("far", "inside")),
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("rgb", "rbg"), "no arm 'rbg'"),
        (("noise", "nosie"), "no condition 'nosie'"),
        (("topdown-wide", "topdown-wid"), "no simulated task"),
        (("steps", "stpes"), "unknown entries stpes"),
        (("[[compare]]", "[[compares]]"), "unknown entries compares"),
        (('arms = ["rgb", "geometry"]', ""), "has no arms"),
        (("seeds = [3, 4]", ""), "at least one training seed"),
        (("seeds = [3, 4]", "seeds = [3,, 4]"), "not valid TOML"),
    ],
)
def test_what_means_nothing_is_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        read_spec(write(tmp_path, SPEC.replace(*change)))


def test_a_file_that_is_not_there_is_named():
    with pytest.raises(FileNotFoundError, match="default"):
        read_spec("defautl")


def test_a_run_is_kept_by_what_it_depends_on(tmp_path):
    """Another budget is another run; another number of evaluation episodes is the same training, evaluated again."""
    run = runs_of(read_spec(write(tmp_path, SPEC)), tmp_path)[0]
    longer = dataclasses.replace(run, budget=dataclasses.replace(run.budget, steps=8))
    more = dataclasses.replace(run, budget=dataclasses.replace(run.budget, evaluation_episodes=51))
    other_data = dataclasses.replace(run, budget=dataclasses.replace(run.budget, episodes=9))
    assert (longer.folder == run.folder, longer.data_folder == run.data_folder) == (False, True)
    assert (more.folder == run.folder, more.outcome("inside") == run.outcome("inside")) == (True, False)
    assert (other_data.folder == run.folder, other_data.data_folder == run.data_folder) == (False, False)


def test_conditions_of_the_depth_sensor_are_not_evaluated_for_arms_without_depth():
    for name, condition in CONDITIONS.items():
        assert equivalent_condition(name, depth=True) == name
        shown = CONDITIONS[equivalent_condition(name, depth=False)]
        assert (shown.cameras, shown.sensor) == (condition.cameras, "ideal")
