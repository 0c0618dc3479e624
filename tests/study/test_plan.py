"""Phases of a study, its stop rule, its report and its estimate, on outcomes that are made up: nothing is trained."""

import dataclasses
import json
from types import SimpleNamespace

import matplotlib.pyplot as plt
import pandas as pd
import pytest
import torch

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.study import adapted, growth_report, simulated
from lerobot_policy_pi05_geometry.study.adapted import AdaptedRun
from lerobot_policy_pi05_geometry.study.conditions import DENOISING_STEPS
from lerobot_policy_pi05_geometry.study.estimate import Costs, estimate
from lerobot_policy_pi05_geometry.study.growth_report import write_growth_report
from lerobot_policy_pi05_geometry.study.plan import phases, runs_of
from lerobot_policy_pi05_geometry.study.pretraining import PretrainingRun
from lerobot_policy_pi05_geometry.study.results import episodes_table
from lerobot_policy_pi05_geometry.study.spec import Budget, Comparison, Growth, Pretraining, StudySpec, Sweep
from lerobot_policy_pi05_geometry.study.stopping import gains, improving_arms

from .fakes import fake_outcomes

pytestmark = pytest.mark.sim

TASKS = ("button-press-topdown-wide", "button-press-wide")
SPEC = StudySpec(
    seeds=(0, 1),
    comparisons=(
        Comparison(TASKS, ("blind", "rgb", "geometry"), ("inside", "outside", "depth-off")),
        Comparison(TASKS, ("rgb", "rgb-wide", "rgb+rays", "rgb+modulation"), ("inside", "outside")),
    ),
    budget=Budget(steps=10, evaluation_episodes=20, episodes=3, adaptation_steps=7),
    pretraining=Pretraining(
        ("faucet-open-wide", "handle-press-wide"), episodes=4, steps=30, evaluated=("faucet-open-wide",)
    ),
    growth=Growth((1, 2, 4)),
    sweep=Sweep((-30, 0, 30), ("rgb", "geometry", "rgb+modulation")),
)


def grows(run, condition: str) -> float:
    """RGB goes on improving inside; geometry improves once; the others never do."""
    if isinstance(run, PretrainingRun):
        return 0.5
    if run.arm_name in ("rgb", "rgb+modulation"):
        return 0.2 + (0.1 * run.multiple if condition == "inside" else 0.0)
    if run.arm_name == "geometry":
        return 0.3 if condition == "depth-off" else 0.6
    return {"blind": 0.05, "rgb-wide": 0.3, "rgb+rays": 0.6}[run.arm_name]


def executed(root, spec=SPEC, rate=grows) -> list:
    done = []
    for phase in phases(spec, root):
        fake_outcomes(phase.runs, rate)
        done.append(phase)
    return done


def test_phases_follow_each_other_and_only_improving_arms_go_on(tmp_path):
    found = executed(tmp_path)
    arms = [sorted({run.arm_name for run in phase.runs}) for phase in found]
    every = ["blind", "geometry", "rgb", "rgb+rays", "rgb-wide"]
    assert arms == [
        ["rgb"],  # the pretraining
        every, ["rgb+modulation"],
        every, ["rgb+modulation"],
        ["rgb"], ["rgb+modulation"],  # it follows the arm that it adapts
        ["geometry", "rgb", "rgb+modulation"],
    ]  # fmt: skip
    assert all(isinstance(run, AdaptedRun) for run in found[2].runs)
    assert {run.multiple for run in found[5].runs} == {4}
    sweep = found[-1].runs
    assert {(run.arm_name, run.multiple) for run in sweep} == {("rgb", 4), ("rgb+modulation", 4), ("geometry", 2)}
    assert all(run.conditions == ("azimuth-30", "azimuth+0", "azimuth+30") for run in sweep)
    trained = {run.folder for phase in found[:-1] for run in phase.runs}
    assert {run.folder for run in sweep} <= trained  # the sweep evaluates, and trains nothing


AFTER_RGB = dataclasses.replace(
    SPEC,
    comparisons=(Comparison(TASKS, ("rgb", "geometry", "geometry-after-rgb"), ("inside", "outside", "depth-off")),),
    sweep=None,
)


def rises(run, condition: str) -> float:
    return 0.2 if isinstance(run, PretrainingRun) else 0.2 + 0.1 * run.multiple


def test_an_arm_after_another_one_has_the_other_half_of_the_steps(tmp_path):
    """It goes on from the run with half of its multiple, and its own first multiple is 2."""
    found = executed(tmp_path, AFTER_RGB, rises)
    folders = {run.folder: run for phase in found[1:] for run in phase.runs}
    after = [run for run in folders.values() if run.arm_name == "geometry-after-rgb"]
    assert sorted({run.multiple for run in after}) == [2, 4]
    for run in after:
        before = folders[run.before.folder]  # the run of the arm itself, not one more
        assert (before.arm_name, before.seed, before.task) == ("rgb", run.seed, run.task)
        assert (before.steps, run.steps) == (run.multiple * 5, run.multiple * 5)
        assert run.source == before.checkpoint
        assert simulated.from_json(json.loads(run.to_json())) == run
    assert len({run.start for run in after if run.task == TASKS[0]}) == 2 * 2  # seeds x multiples
    twice = dataclasses.replace(after[0], pretraining=dataclasses.replace(SPEC.pretraining, seed=1))
    assert twice.start != after[0].start
    steps = Costs(step=1.0, episode=1.0, recording=0.0)
    assert estimate(AFTER_RGB, tmp_path, steps).most == 0.0


def test_an_arm_after_another_one_stops_by_the_same_rule(tmp_path):
    def rate(run, condition):
        return 0.5 if isinstance(run, PretrainingRun) or run.arm_name == "geometry-after-rgb" else rises(run, condition)

    spec = dataclasses.replace(AFTER_RGB, growth=Growth((1, 2, 4, 8)))
    runs = [run for phase in executed(tmp_path, spec, rate)[1:] for run in phase.runs]
    multiples = {
        arm: sorted({run.multiple for run in runs if run.arm_name == arm}) for arm in ("rgb", "geometry-after-rgb")
    }
    assert multiples == {"rgb": [1, 2, 4, 8], "geometry-after-rgb": [2, 4]}


def test_an_arm_after_another_one_ends_with_it(tmp_path):
    """Without RGB at 4 x there is nothing to go on from at 8 x, however much the arm itself gained."""

    def rate(run, condition):
        return 0.5 if isinstance(run, PretrainingRun) or run.arm_name == "rgb" else min(1.0, rises(run, condition))

    spec = dataclasses.replace(AFTER_RGB, growth=Growth((1, 2, 4, 8)))
    runs = [run for phase in executed(tmp_path, spec, rate)[1:] for run in phase.runs]
    assert max(run.multiple for run in runs if run.arm_name == "rgb") == 2
    assert max(run.multiple for run in runs if run.arm_name == "geometry-after-rgb") == 4


def test_azimuths_may_be_compared_and_swept(tmp_path, monkeypatch):
    """The table has a compared one after the longest training, and the sweep nothing but that, once."""
    drawn = {}
    monkeypatch.setattr(
        growth_report, "sweep_figure", lambda tasks, azimuths, arms, trained: drawn.update(arms) or plt.figure()
    )

    def rate(run, condition):
        return 0.1 if run.multiple == 1 else 0.9

    spec = dataclasses.replace(
        SPEC,
        pretraining=None,
        comparisons=(
            Comparison(TASKS[:1], ("rgb", "geometry"), ("inside", "outside", "azimuth+30", "azimuth+50-steps-3")),
        ),
        growth=Growth((1, 2)),
        sweep=Sweep((-30, 30), ("rgb", "geometry")),
    )
    runs = [run for phase in executed(tmp_path, spec, rate) for run in phase.runs]
    page = write_growth_report(tmp_path, spec, runs, "pi05-geometry study").read_text()
    for title in ("camera at +30 degrees", "camera at +50 degrees, 3 denoising steps"):
        assert title in page
    assert "camera at -30 degrees" not in page  # swept only
    for arm in ("rgb", "geometry"):
        assert drawn[arm][0][0] == pytest.approx([0.9, 0.9])
    table = pd.read_csv(tmp_path / "episodes.csv")
    assert not table.duplicated().any()
    assert (table["condition"] == "azimuth+30").sum() == 2 * 2 * 2 * 20  # arms x multiples x seeds x episodes


def test_a_curve_stands_at_the_steps_that_it_was_trained_with(tmp_path, monkeypatch):
    drawn = {}
    real = growth_report.growth_figure
    monkeypatch.setattr(
        growth_report,
        "growth_figure",
        lambda titles, steps, arms, floors: drawn.update(arms) or real(titles, steps, arms, floors),
    )
    runs = [run for phase in executed(tmp_path, AFTER_RGB, rises) for run in phase.runs]
    write_growth_report(tmp_path, AFTER_RGB, runs, "pi05-geometry study")
    assert {arm: list(panels[0]) for arm, panels in drawn.items()} == {
        "rgb": [10, 20, 40], "geometry": [10, 20, 40], "geometry-after-rgb": [20, 40]
    }  # fmt: skip
    assert drawn["geometry-after-rgb"][0][40] == pytest.approx([0.6, 0.6])


def test_a_crashed_pretraining_ends_the_study(tmp_path):
    runs = next(phases(SPEC, tmp_path)).runs
    runs[0].folder.mkdir(parents=True)
    runs[0].crash.write_text("{}")
    with pytest.raises(RuntimeError, match="pretraining crashed"):
        list(phases(SPEC, tmp_path))


@pytest.mark.parametrize(("gained", "improving"), [(0.04, set()), (0.05, {"rgb"}), (-0.2, set())])
def test_the_stop_rule_pools_tasks_and_seeds(tmp_path, gained, improving):
    """A gain on one task alone counts half."""
    spec = dataclasses.replace(
        SPEC,
        comparisons=(Comparison(TASKS, ("rgb",), ("inside", "outside")),),
        budget=Budget(evaluation_episodes=50),
        sweep=None,
    )

    def rate(run, condition):
        gain = 2 * gained if run.multiple == 2 and run.task == TASKS[0] and condition == "outside" else 0.0
        return 0.4 + gain

    runs = [run for multiple in (1, 2) for run in runs_of(spec, tmp_path, multiple)]
    fake_outcomes(runs, rate)
    found = gains(episodes_table(runs), spec.growth)
    assert {gain.condition: gain.gain for gain in found} == pytest.approx({"inside": 0.0, "outside": gained})
    assert all(gain.low <= gain.gain <= gain.high for gain in found)
    assert improving_arms(found, spec.growth) == improving


def test_the_report_holds_every_part(tmp_path):
    runs = [run for phase in executed(tmp_path) for run in phase.runs]
    page = write_growth_report(tmp_path, SPEC, runs, "pi05-geometry study").read_text()
    assert page.count("<img ") == 1 + len(TASKS) + 1  # growth, one per task, sweep
    for text in ("still improving", "stopped", "Azimuth sweep", "+30 points", "geometry succeeds in 60%"):
        assert text in page, text
    table = pd.read_csv(tmp_path / "episodes.csv")
    assert set(table["multiple"]) == {1, 2, 4}
    assert set(table[table["condition"] == "azimuth+30"]["arm"]) == {"rgb", "geometry", "rgb+modulation"}
    verdicts = pd.read_csv(tmp_path / "claims.csv").set_index("claim")["verdict"]
    assert list(verdicts) == ["yes", "yes", "no", "yes", "no", "yes"]


def test_one_multiple_above_1_and_a_sweep_have_a_report_too(tmp_path):
    spec = dataclasses.replace(
        SPEC,
        comparisons=(Comparison(TASKS[:1], ("rgb", "geometry"), ("inside", "outside")),),
        growth=Growth((4,)),
        sweep=Sweep((-30, 0, 30), ("rgb", "geometry")),
    )
    runs = [run for phase in executed(tmp_path, spec) for run in phase.runs]
    page = write_growth_report(tmp_path, spec, runs, "pi05-geometry study").read_text()
    assert page.count("<img ") == 3  # growth, the task, sweep
    assert "geometry succeeds in 60%" in page
    assert set(pd.read_csv(tmp_path / "episodes.csv")["multiple"]) == {4}


def test_the_estimate_adds_up_what_is_missing(tmp_path):
    """Counted by hand: 8 trained arm-seeds with 5 arms and 2 tasks are 20 runs for each multiple."""
    steps = Costs(step=3600.0, episode=0.0, recording=0.0)
    adapted = 2 * 2 * 7  # tasks x seeds x steps, for each condition
    least = 30 + 20 * 10 * (1 + 2) + adapted * (2 + 2 + 3)  # two conditions for each multiple, three azimuths
    most = 30 + 20 * 10 * (1 + 2 + 4) + adapted * (2 + 2 + 2 + 3)
    found = estimate(SPEC, tmp_path, steps)
    assert (found.least, found.most) == (pytest.approx(least), pytest.approx(most))
    recordings = Costs(step=0.0, episode=0.0, recording=3600.0)
    demonstrations = 2 * 2 * 2  # tasks x seeds x conditions
    assert estimate(SPEC, tmp_path, recordings).least == pytest.approx(2 * 4 + 2 * 2 * 3 + demonstrations)
    runs = [run for phase in executed(tmp_path) for run in phase.runs]
    assert runs
    left = estimate(SPEC, tmp_path, Costs(step=3600.0, episode=3600.0, recording=0.0))
    assert left.least == pytest.approx(0.0)
    assert left.most > 0  # arms that stopped would have had more


def test_the_study_that_comes_along_is_the_one_that_was_promised(tmp_path):
    from lerobot_policy_pi05_geometry.study.spec import read_spec

    spec = read_spec("warm-start")
    assert len(spec.seeds) >= 3
    assert spec.growth == Growth((1, 2, 4), 0.05, ("inside", "outside"))
    assert spec.budget.evaluation_episodes >= 100
    assert spec.pretraining is not None
    assert len(spec.pretraining.tasks) > 2
    runs = runs_of(spec, tmp_path)
    tasks = {run.task for run in runs}
    assert len(tasks) >= 2
    assert not tasks & set(spec.pretraining.tasks)  # the tasks are new
    arms = {"blind", "rgb", "geometry", "rgb-wide", "rgb+rays", "rgb+modulation"}
    assert {(run.task, run.arm_name) for run in runs} == {(task, arm) for task in tasks for arm in arms}
    geometry = next(run for run in runs if run.arm_name == "geometry")
    assert {"inside", "outside", "depth-off", "noise", "calibration-1"} <= set(geometry.conditions)


def test_an_adapted_policy_is_built_with_its_training_seed(tmp_path, monkeypatch):
    """A policy takes the seed of its training noise then; so the same run gives the same policy in any process."""
    seen = []
    monkeypatch.setattr(adapted, "adapt", lambda *_: None)
    monkeypatch.setattr(adapted, "LeRobotDataset", lambda *_, **__: None)
    loaded = SimpleNamespace(policy=SimpleNamespace(config=PI05GeometryConfig(device="cpu")))
    monkeypatch.setattr(simulated, "load_policy", lambda *_, **__: seen.append(torch.initial_seed()) or loaded)
    for run in runs_of(SPEC, tmp_path):
        if run.arm_name == "rgb+modulation":
            torch.seed()
            run.load("inside", run.simulated.environment("train", 28))
    assert seen == [0, 0, 1, 1]


@pytest.mark.parametrize("arm", ["geometry", "rgb+modulation"])
def test_a_condition_of_denoising_steps_reaches_the_policy(arm, tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(adapted, "adapt", lambda *_: None)
    monkeypatch.setattr(adapted, "LeRobotDataset", lambda *_, **__: None)
    loaded = SimpleNamespace(policy=SimpleNamespace(config=PI05GeometryConfig(device="cpu")))
    monkeypatch.setattr(simulated, "load_policy", lambda *_, **options: given.append(options) or loaded)
    run = next(run for run in runs_of(SPEC, tmp_path) if run.arm_name == arm)
    for condition in ("inside", "steps-3", "steps-10"):
        run.load(condition, run.simulated.environment("train", 28))
    assert given == [
        {"num_inference_steps": steps} for steps in (DENOISING_STEPS, 3, 10)
    ]  # whatever the checkpoint has
    assert len({run.outcome(condition) for condition in ("inside", "steps-3", "steps-10")}) == 3
