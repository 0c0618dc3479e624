"""What a study file may say, what it means, and what it is told when it says something else."""

import dataclasses
import json
import re

import pytest

from lerobot_policy_pi05_geometry.sim.cameras import find_range
from lerobot_policy_pi05_geometry.study.arms import ARMS
from lerobot_policy_pi05_geometry.study.conditions import (
    CONDITIONS,
    DENOISING_STEPS,
    azimuth_condition,
    azimuth_of,
    equivalent_condition,
    find_condition,
    order_of,
)
from lerobot_policy_pi05_geometry.study.plan import runs_of
from lerobot_policy_pi05_geometry.study.pretraining import read_pretraining
from lerobot_policy_pi05_geometry.study.simulated import from_json
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
    of_other_studies = {
        "rgb+rays",
        "rgb+modulation",
        "augmented",
        "noise-times",
        "uniform-times",
        "even-dropout",
        "pooled",
        "geometry-after-rgb",
    }
    assert max(arms.values(), key=len) == set(ARMS) - of_other_studies
    assert len(arms) >= 3
    for task, on_task in arms.items():
        assert {"blind", "rgb", "rgb-wide", "geometry"} <= on_task
        assert conditions[task, "geometry"] == set(CONDITIONS) - {"far", "fixed", "plus"}
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[3, 4]", "[0, 0]"), "seeds names 0 more than once"),
        (("[3, 4]", '["a"]'), "seeds must be a list of whole numbers of at least 0, got ['a']"),
        (("[3, 4]", "[true]"), "got [True]"),
        (("[3, 4]", "[-1]"), "got [-1]"),
        (("[3, 4]", "3"), "seeds must be a list of whole numbers of at least 0, got 3"),
        (("steps = 7", "evaluation_episodes = 0"), "evaluation_episodes must be a whole number of at least 1, got 0"),
        (("steps = 7", 'steps = "1500"'), "steps must be a whole number of at least 1, got '1500'"),
        (("steps = 7", "steps = 0"), "steps must be"),
        (("steps = 7", "steps = 7.5"), "steps must be"),
        (("steps = 7", "parallel = 0"), "parallel must be"),
        (("steps = 7", "videos = -1"), "videos must be a whole number of at least 0"),
        (("steps = 7", "learning_rate = 0"), "learning_rate must be above 0"),
        (("steps = 7", "learning_rate = nan"), "learning_rate must be a number, got nan"),
        (("steps = 7", 'variant = "huge"'), "variant must be one of small, tiny, got 'huge'"),
        (("steps = 7", "action_steps = 20"), "action_steps (20) cannot exceed chunk_size (8)"),
        (("[budget]\nsteps = 7", "budget = 3"), "[budget] of"),
        (("[[compare]]", "[compare]"), "each begun with [[compare]]"),
        ((SPEC[SPEC.index("[budget]") :], "compare = 3"), "each begun with [[compare]], got 3"),
        ((SPEC[SPEC.index("[budget]") :], "compare = [3]"), "[[compare]] of"),
        (('["rgb", "geometry"]', '"rgb"'), "arms must be a list of texts, got 'rgb'"),
        (('["rgb", "geometry"]', '["rgb", "rgb"]'), "arms names rgb more than once"),
    ],
)
def test_a_value_that_cannot_be_is_named_before_anything_is_trained(tmp_path, change, message):
    assert change[0] in SPEC
    with pytest.raises(ValueError, match=re.escape(message)):
        read_spec(write(tmp_path, SPEC.replace(*change)))


def test_an_arm_is_for_training_from_scratch_if_a_conversion_would_undo_it():
    """For a converted policy these would crash (prefix), or train another arm under their name."""
    assert [name for name, arm in ARMS.items() if arm.from_scratch] == ["prefix", "gate-closed", "parallel"]


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


def test_a_fault_is_evaluated_only_for_arms_that_read_what_it_changes():
    for name, condition in CONDITIONS.items():
        for arm in ARMS.values():
            evaluated = CONDITIONS[equivalent_condition(name, arm)]
            assert evaluated.cameras == condition.cameras
            assert evaluated.sensor == (condition.sensor if condition.changes in arm.reads else "ideal")
    rays = ARMS["rgb+rays"]  # they know the camera's pose, and measure no depth
    assert equivalent_condition("calibration-5", rays) == "calibration-5"
    assert equivalent_condition("depth-off", rays) == "inside"


def test_an_azimuth_is_a_condition():
    condition = find_condition(azimuth_condition(-30))
    assert (condition.cameras, condition.sensor) == ("azimuth-30", "ideal")
    assert azimuth_of(azimuth_condition(-30)) == -30
    assert azimuth_of(azimuth_condition(7.5)) == 7.5
    assert azimuth_of("azimuth-30-steps-3") == -30
    assert azimuth_of("outside") is None
    assert find_range(condition.cameras).azimuth == ((-30.0, -30.0),)
    for wrong in ("azimuth", "azimuth+north", "azimuthnan", "azimuth+inf"):
        with pytest.raises(ValueError, match="no camera range"):
            find_range(wrong)


def test_a_number_of_denoising_steps_is_a_condition():
    assert find_condition("steps-3").denoising_steps == 3
    assert find_condition("inside").denoising_steps == DENOISING_STEPS
    for wrong in ("steps-0", "steps-", "steps--1", "steps-2.5", "steps-²"):
        with pytest.raises(ValueError, match="no condition 'steps-"):
            find_condition(wrong)


def test_any_condition_may_have_a_number_of_denoising_steps():
    for name in (*CONDITIONS, azimuth_condition(30)):
        plain, few = find_condition(name), find_condition(f"{name}-steps-3")
        assert few.denoising_steps == 3
        assert (few.cameras, few.sensor, few.changes) == (plain.cameras, plain.sensor, plain.changes)
    rgb, geometry = ARMS["rgb"], ARMS["geometry"]
    # One name for one evaluation, or it would be run twice.
    assert equivalent_condition("depth-off-steps-3", geometry) == "depth-off-steps-3"
    assert equivalent_condition("depth-off-steps-3", rgb) == "steps-3"
    assert equivalent_condition("inside-steps-3", geometry) == "steps-3"
    assert equivalent_condition(f"outside-steps-{DENOISING_STEPS}", geometry) == "outside"
    assert equivalent_condition(f"steps-{DENOISING_STEPS}", geometry) == "inside"
    assert sorted(["outside-steps-1", "steps-3", "outside", "inside"], key=order_of) == [
        "inside",
        "steps-3",
        "outside",
        "outside-steps-1",
    ]
    with pytest.raises(ValueError, match="no condition 'nowhere'"):
        find_condition("nowhere-steps-1")


GROWING = (
    SPEC.replace('"noise"]', '"outside"]')
    + """
[pretrain]
tasks = ["faucet-open-wide"]
[growth]
multiples = [1, 3]
[sweep]
azimuths = [-30, 30]
arms = ["rgb"]
"""
)


def test_a_warm_start_is_read_and_reaches_the_worker(tmp_path):
    spec = read_spec(write(tmp_path, GROWING))
    assert (spec.growth.multiples, spec.sweep.azimuths) == ((1, 3), (-30, 30))
    run = runs_of(spec, tmp_path, 3)[1]
    assert (run.steps, run.pretraining.tasks) == (21, ("faucet-open-wide",))
    assert from_json(json.loads(run.to_json())) == run
    assert read_pretraining(json.loads(run.origin.to_json())["pretraining"]) == spec.pretraining
    once = runs_of(spec, tmp_path)[1]
    scratch = runs_of(read_spec(write(tmp_path, SPEC)), tmp_path)[1]
    assert len({run.folder, once.folder, scratch.folder}) == 3
    assert run.start == once.start  # however long it is trained
    other = dataclasses.replace(run, pretraining=dataclasses.replace(run.pretraining, steps=5))
    assert (other.folder == run.folder, other.start == run.start) == (False, False)
    more = dataclasses.replace(run.pretraining, evaluated=run.pretraining.tasks)
    assert dataclasses.replace(run, pretraining=more).folder == run.folder  # only evaluated in addition
    arguments = run.arguments(tmp_path / "output")
    assert f"--policy.path={run.start}" in arguments
    assert not [a for a in arguments if a.startswith(("--policy.type", "--policy.geometry_source"))]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[1, 3]", "[3, 1]"), "rise from 1 on"),
        (("[1, 3]", "[0, 3]"), "rise from 1 on"),
        (("faucet-open-wide", "faucet"), "no simulated task"),
        (('tasks = ["faucet-open-wide"]\n', ""), "incomplete"),
        (('arms = ["rgb"]\n', 'arms = ["grid-4"]\n'), "grid-4, which no"),
        (('"outside"]', '"noise"]'), "decides by the conditions inside, outside"),
        (('arms = ["rgb", "geometry"]', 'arms = ["rgb+modulation"]'), "adapts arm 'rgb'"),
        (('arms = ["rgb", "geometry"]', 'arms = ["geometry-after-rgb"]'), "goes on from arm 'rgb'; name both"),
        (
            ('arms = ["rgb", "geometry"]', 'arms = ["rgb", "geometry-after-rgb"]'),
            "needs two multiples of which one is twice",
        ),
        (('arms = ["rgb", "geometry"]', 'arms = ["rgb", "prefix"]'), "'prefix' is for policies trained from scratch"),
        (("[growth]", "[growth]\nfactor = 2"), "unknown entries factor"),
        (('["faucet-open-wide"]', '["faucet-open-wide"]\nevaluated = ["reach-v3"]'), "on which it is not trained"),
    ],
)
def test_a_warm_start_that_does_not_fit_is_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        read_spec(write(tmp_path, GROWING.replace(*change)))


@pytest.mark.parametrize(
    ("azimuths", "message"),
    [
        ("[]", "at least one azimuth"),
        ('["x"]', "azimuths must be a list of numbers, got"),
        ("[1000]", "within -180 and 180 degrees, got"),
        ("[nan]", "azimuths must be a list of numbers, got"),
        ("[30, 30]", "names 30 more than once"),
    ],
)
def test_azimuths_that_no_camera_has_are_refused(tmp_path, azimuths, message):
    with pytest.raises(ValueError, match=message):
        read_spec(write(tmp_path, GROWING.replace("[-30, 30]", azimuths)))


def test_a_sweep_of_a_task_without_azimuths_is_refused(tmp_path):
    libero = LIBERO.format(task="libero_goal/8-near", arm="geometry", condition="inside")
    sweep = '[sweep]\nazimuths = [30]\narms = ["{arm}"]\n'
    with pytest.raises(ValueError, match=r"sweep. is not possible on libero_goal/8-near"):
        read_spec(write(tmp_path, libero + sweep.format(arm="geometry")))
    both = libero + SPEC[SPEC.index("[[compare]]") :].replace('"geometry"', '"blind"')
    assert read_spec(write(tmp_path, both + sweep.format(arm="blind"))).sweep  # of the other task alone


LIBERO = """
seeds = [0]
[[compare]]
tasks = ["{task}"]
arms = ["{arm}"]
conditions = ["{condition}"]
"""


def test_a_task_of_libero_needs_no_libero_to_be_read(tmp_path):
    path = tmp_path / "libero.toml"
    path.write_text(LIBERO.format(task="libero_goal/8-far-front", arm="blind", condition="plus"))
    (run,) = runs_of(read_spec(path), tmp_path)
    assert (run.simulated.views, run.simulated.action_dim) == (("front",), 7)
    assert json.loads(run.options["policy.input_features"])["observation.state"]["shape"] == [8]
    environment = run.simulated.environment("outside", 84, "noisy")
    assert (environment.task, environment.task_ids, environment.placement) == ("libero_goal", [8], "far")


@pytest.mark.parametrize(
    ("task", "arm", "condition", "message"),
    [
        ("libero_goal/8", "rgb", "inside", "a task of LIBERO is a suite"),
        ("libero_10/8-near", "rgb", "inside", "a task of LIBERO is a suite"),
        ("libero_goal/8-away", "rgb", "inside", "placement of objects"),
        ("libero_goal/8-near", "rgb", "far", "no camera range 'far'"),
        ("libero_goal/8-near", "rgb-wide", "inside", "no camera range 'wide'"),
        ("button-press-topdown-wide", "rgb", "plus", "no camera range 'plus'"),
    ],
)
def test_a_task_and_what_it_lacks_is_refused(task, arm, condition, message, tmp_path):
    path = tmp_path / "libero.toml"
    path.write_text(LIBERO.format(task=task, arm=arm, condition=condition))
    with pytest.raises(ValueError, match=message):
        read_spec(path)


def test_tasks_that_one_pretraining_cannot_serve_are_refused(tmp_path):
    path = tmp_path / "libero.toml"
    content = LIBERO.format(task="libero_goal/8-near-front", arm="rgb", condition="inside")
    path.write_text(
        content.replace("[[compare]]", '[pretrain]\ntasks = ["libero_goal/0-near"]\ncameras = "train"\n[[compare]]')
    )
    with pytest.raises(ValueError, match="same cameras, state and actions"):
        read_spec(path)
