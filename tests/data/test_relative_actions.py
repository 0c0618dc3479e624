"""Relative actions: every executed target is the one that its chunk was predicted with."""

import copy
import json
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.configs import NormalizationMode
from lerobot.policies import make_pre_post_processors
from lerobot.policies.rtc import reanchor_relative_rtc_prefix
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    NormalizerProcessorStep,
    PolicyProcessorPipeline,
    RelativeActionsProcessorStep,
)
from torch import Tensor

from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy, load_policy
from lerobot_policy_pi05_geometry.data.relative_actions import ACTION_ANCHOR, relative_to
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from lerobot_policy_pi05_geometry.sim.evaluate import _rollout
from tests.drifting import (
    CHUNK,
    FRONT,
    JOINTS,
    Q01,
    Q99,
    RELATIVE,
    STATE,
    STEPS,
    DriftingEnv,
    DriftingEnvConfig,
    Prediction,
    action_stats,
    image_of,
    record_predictions,
    relative_config,
    state_of,
    write_checkpoint,
)
from tests.driftingarm import DriftingArm
from tests.entry_points import redraw

EXACT = {"rtol": 0.0, "atol": 1e-6}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """A saved policy; do not change it."""
    return write_checkpoint(tmp_path_factory.mktemp("relative") / "policy")


@pytest.fixture
def predictions(monkeypatch) -> list[Prediction]:
    return record_predictions(monkeypatch)


@pytest.fixture
def loaded(checkpoint) -> LoadedPolicy:
    return load_policy(checkpoint)


def observe(*ticks: int) -> dict[str, Any]:
    """A raw observation of several environments."""
    images = torch.stack([torch.from_numpy(image_of(tick)).permute(2, 0, 1).float() / 255 for tick in ticks])
    return {FRONT: images, STATE: torch.stack([state_of(tick) for tick in ticks]), "task": ["reach"] * len(ticks)}


def act(loaded: LoadedPolicy, *ticks: int) -> Tensor:
    """One tick of a control loop: the target that is sent to the robot, (B, A)."""
    return loaded.postprocess(loaded.policy.select_action(loaded.preprocess(observe(*ticks))))


# --- one control loop ---------------------------------------------------------------------------------------------


def test_queued_actions_keep_the_state_that_their_chunk_was_predicted_from(loaded, predictions):
    sent = [act(loaded, tick) for tick in range(10)]
    assert [p.ticks for p in predictions] == [[0], [4], [8]]
    for tick, target in enumerate(sent):
        torch.testing.assert_close(target, predictions[tick // STEPS].targets()[:, tick % STEPS], **EXACT)
    drift = sent[1] - (predictions[0].targets()[:, 1] + (state_of(1) - state_of(0)) * torch.tensor(RELATIVE))
    assert drift.abs().max() > 0.1  # the fault was this large here


def test_a_whole_chunk_and_its_queued_actions_are_the_same(loaded):
    torch.manual_seed(3)
    chunk = loaded.postprocess(loaded.policy.predict_action_chunk(loaded.preprocess(observe(5, 9))))
    torch.manual_seed(3)
    loaded.policy.reset()
    sent = [act(loaded, 5 + t, 9 + t) for t in range(STEPS)]
    assert torch.equal(torch.stack(sent, dim=1), chunk[:, :STEPS])


def test_a_reset_drops_what_was_queued_with_its_state(loaded, predictions):
    act(loaded, 0)
    act(loaded, 1)
    loaded.policy.reset()
    target = act(loaded, 40)
    torch.testing.assert_close(target, predictions[-1].targets()[:, 0], **EXACT)
    assert predictions[-1].ticks == [40]


def test_two_policies_may_share_processors_and_take_turns(loaded, predictions):
    """Neither processors nor module keep anything between calls."""
    other = LoadedPolicy(copy.deepcopy(loaded.policy), loaded.preprocess, loaded.postprocess)
    first = [act(loaded, 0), act(loaded, 1)]
    second = [act(other, 50), act(other, 51)]
    first.append(act(loaded, 2))
    for sent, prediction in zip((first, second), predictions, strict=True):
        for step, target in enumerate(sent):
            torch.testing.assert_close(target, prediction.targets()[:, step], **EXACT)


def test_observations_may_be_prepared_before_other_chunks_are_sent(loaded, predictions):
    batches = [loaded.preprocess(observe(tick)) for tick in (3, 30, 13)]
    chunks = [loaded.policy.predict_action_chunk(batch) for batch in batches]
    for chunk, prediction in zip(chunks, predictions, strict=True):
        torch.testing.assert_close(loaded.postprocess(chunk), prediction.targets(), **EXACT)


def test_saved_and_loaded_again_it_acts_the_same(checkpoint, tmp_path):
    first = load_policy(checkpoint)
    first.policy.save_pretrained(tmp_path / "again")
    first.preprocess.save_pretrained(tmp_path / "again")
    first.postprocess.save_pretrained(tmp_path / "again")
    again = load_policy(tmp_path / "again")
    for seen in (first, again):
        torch.manual_seed(1)
        seen.policy.reset()
        seen.sent = torch.stack([act(seen, tick) for tick in range(6)])
    assert torch.equal(first.sent, again.sent)


@pytest.mark.parametrize(
    ("mode", "stats"),
    [
        (NormalizationMode.MIN_MAX, {"min": Q01, "max": Q99}),
        (NormalizationMode.QUANTILE10, {"q10": Q01, "q90": Q99}),
        (NormalizationMode.MEAN_STD, {"mean": (Q01 + Q99) / 2, "std": (Q99 - Q01) / 2}),
        (NormalizationMode.QUANTILES, {"q01": Q01, "q99": Q99}),
    ],
)
def test_every_normalisation_of_actions_is_undone(mode, stats, predictions):
    mapping = {"STATE": NormalizationMode.QUANTILES, "ACTION": mode}
    config = relative_config(normalization_mapping=mapping)
    policy = redraw(PI05GeometryPolicy(config)).eval()
    preprocess, postprocess = make_pi05_geometry_pre_post_processors(config, action_stats(**stats))
    sent = [act(LoadedPolicy(policy, preprocess, postprocess), tick) for tick in range(3)]
    for step, target in enumerate(sent):
        torch.testing.assert_close(target, predictions[0].targets()[:, step], **EXACT)


def test_actions_that_are_not_normalised_are_anchored_too(predictions):
    config = relative_config(
        normalization_mapping={"STATE": NormalizationMode.QUANTILES, "ACTION": NormalizationMode.IDENTITY}
    )
    policy = redraw(PI05GeometryPolicy(config)).eval()
    preprocess, postprocess = make_pi05_geometry_pre_post_processors(config, action_stats())
    sent = [act(LoadedPolicy(policy, preprocess, postprocess), tick) for tick in range(2)]
    for step, target in enumerate(sent):
        relative = predictions[0].chunk[:, step]
        torch.testing.assert_close(target, relative + state_of(0) * torch.tensor(RELATIVE), **EXACT)


def test_a_relative_dimension_without_width_still_follows_the_state(predictions):
    """A joint whose action is always its state: its relative action is constant."""
    still = {"q01": Q01.clone(), "q99": Q99.clone()}
    still["q01"][1] = still["q99"][1] = 0.0
    config = relative_config()
    policy = redraw(PI05GeometryPolicy(config)).eval()
    bounds = {"min": still["q01"], "max": still["q99"]}
    pipelines = make_pi05_geometry_pre_post_processors(config, action_stats(**still, **bounds))
    sent = [act(LoadedPolicy(policy, *pipelines), tick) for tick in range(3)]
    for target in sent:
        torch.testing.assert_close(target[0, 1], state_of(0)[1], **EXACT)


# --- LeRobot's own commands ---------------------------------------------------------------------------------------


def test_lerobot_eval_executes_the_chunks_own_targets(checkpoint, predictions, tmp_path, monkeypatch):
    """Two environments at once, twice, with an episode that ends before the queue is empty."""
    from lerobot.scripts import lerobot_eval

    DriftingEnv.received.clear()
    arguments = [
        f"--policy.path={checkpoint}", "--policy.device=cpu", "--env.type=drifting", "--eval.n_episodes=4",
        "--eval.batch_size=2", "--eval.use_async_envs=false", f"--output_dir={tmp_path}",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *arguments])
    lerobot_eval.eval_main()
    assert_executed([actions for _, actions in DriftingEnv.received if actions], predictions)


def test_our_evaluation_executes_the_chunks_own_targets(loaded, predictions):
    DriftingEnv.received.clear()
    vector = DriftingEnvConfig().create_envs(2)["drifting"][0]
    for seed in (0, 2):
        _rollout(loaded, vector, [seed, seed + 1], keep_frames=False)
    assert_executed([actions for _, actions in DriftingEnv.received if actions], predictions)


def assert_executed(episodes: list[list[Any]], predictions: list[Prediction]) -> None:
    """Each episode's actions are the targets of its chunks: rows of the batch are environments, chunks follow each other."""
    length = DriftingEnv._max_episode_steps
    chunks = -(-length // STEPS)
    assert len(episodes) == 4
    assert len(predictions) == 2 * chunks
    for number, actions in enumerate(episodes):
        assert len(actions) == length
        own = predictions[number // 2 * chunks :]
        for step, action in enumerate(actions):
            target = own[step // STEPS].targets()[number % 2, step % STEPS]
            torch.testing.assert_close(torch.from_numpy(action), target, **EXACT)


def roll_out(checkpoint: Path, monkeypatch, *options: str, ticks: int) -> Tensor:
    """The targets that the real `lerobot-rollout` sent to the robot, (ticks, A).

    Its clock ticks five times a second, so that a slow machine delays no action by more than one tick; ticks are shorter.
    """
    from lerobot.rollout.strategies import base
    from lerobot.scripts import lerobot_rollout

    DriftingArm.sent.clear()
    arguments = [
        f"--policy.path={checkpoint}", "--policy.device=cpu", "--robot.type=drifting_arm", f"--robot.ticks={ticks}",
        "--task=reach", "--fps=5", "--return_to_initial_position=false", "--play_sounds=false", *options,
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["lerobot-rollout", *arguments])
    monkeypatch.setattr(lerobot_rollout, "init_logging", lambda: None)  # it would take the loggers from pytest
    if hasattr(base, "CycleTimer"):  # LeRobot 0.6.2
        monkeypatch.setattr(base.CycleTimer, "wait", lambda _: time.sleep(0.03))
    else:
        monkeypatch.setattr(base, "precise_sleep", lambda _: time.sleep(0.03))
    lerobot_rollout.rollout()
    return torch.tensor(DriftingArm.sent)


def test_lerobot_rollout_executes_the_chunks_own_targets(checkpoint, predictions, monkeypatch):
    sent = roll_out(checkpoint, monkeypatch, "--inference.type=sync", ticks=10)
    assert len(sent) == 10
    for step, target in enumerate(sent):
        torch.testing.assert_close(target, predictions[step // STEPS].targets()[0, step % STEPS], **EXACT)


def test_rollout_with_real_time_chunking_executes_the_chunks_own_targets(checkpoint, predictions, monkeypatch):
    """What is left of a chunk guides the next one, relative to the new state: as LeRobot's own arithmetic has it."""
    options = "--inference.type=rtc", "--inference.rtc.execution_horizon=3", "--inference.queue_threshold=3"
    sent = roll_out(checkpoint, monkeypatch, *options, ticks=24)
    assert len(sent) == 24
    targets = torch.cat([p.targets()[0] for p in predictions])  # (chunks * CHUNK, A)
    found = [(targets - target).abs().amax(dim=1).argmin().item() for target in sent]
    torch.testing.assert_close(sent, targets[found], **EXACT)
    assert found == sorted(found)
    assert len({row // CHUNK for row in found}) > 1
    normaliser = NormalizerProcessorStep(relative_config().output_features, {"ACTION": "QUANTILES"}, action_stats())
    step = RelativeActionsProcessorStep(True, ["gripper"], JOINTS)
    guided = 0
    for before, prediction in pairwise(predictions):
        assert prediction.prefix is not None
        rows = prediction.prefix[(prediction.prefix != 0).any(dim=1)]  # LeRobot pads with zeros
        expected = reanchor_relative_rtc_prefix(
            before.targets()[0], state_of(prediction.ticks[0]), step, normaliser, torch.device("cpu")
        )
        if len(rows):
            windows = expected.unfold(0, len(rows), 1).transpose(1, 2)  # (starts, rows, A)
            assert (windows - rows).abs().amax(dim=(1, 2)).min() < 1e-4
            guided += 1
    assert guided


# --- in training --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_ndim", [2, 3])
def test_training_actions_are_lerobots_to_the_bit(checkpoint, action_ndim):
    preprocess = load_policy(checkpoint).preprocess
    action = torch.randn(2, *[CHUNK] * (action_ndim - 2), len(JOINTS))
    found = preprocess(observe(4, 7) | {"action": action})["action"]
    theirs = PolicyProcessorPipeline(
        [
            RelativeActionsProcessorStep(True, ["gripper"], JOINTS),
            NormalizerProcessorStep(relative_config().output_features, {"ACTION": "QUANTILES"}, action_stats()),
        ]
    )
    assert torch.equal(found, theirs(observe(4, 7) | {"action": action})["action"])


def test_a_prediction_on_training_data_is_anchored_at_its_own_frame(loaded, predictions):
    batch = loaded.preprocess(observe(4, 7) | {"action": torch.randn(2, CHUNK, len(JOINTS))})
    assert batch["action"].shape == (2, CHUNK, len(JOINTS))
    chunk = loaded.postprocess(loaded.policy.predict_action_chunk(batch))
    torch.testing.assert_close(chunk, predictions[0].targets(), **EXACT)


def test_lerobot_train_switches_relative_actions_on_in_a_checkpoint_without(tmp_path):
    """As `lerobot-train --policy.path=... --policy.use_relative_actions=true` overrides the saved steps."""
    folder = write_checkpoint(tmp_path / "absolute", use_relative_actions=False)
    absolute, _ = make_pre_post_processors(relative_config(), str(folder))
    assert ACTION_ANCHOR not in absolute(observe(2))
    overrides = {"enabled": True, "exclude_joints": ["gripper"], "action_names": JOINTS}
    preprocess, _ = make_pre_post_processors(
        relative_config(),
        str(folder),
        preprocessor_overrides={"relative_actions_processor": overrides},
        postprocessor_overrides={"absolute_actions_processor": {"enabled": True}},
    )
    expected, _ = make_pi05_geometry_pre_post_processors(relative_config(), action_stats())
    batch = observe(2, 3) | {"action": torch.randn(2, CHUNK, len(JOINTS))}
    for key in ("action", ACTION_ANCHOR):
        assert torch.equal(preprocess(dict(batch))[key], expected(dict(batch))[key])
    preprocess.save_pretrained(tmp_path / "saved")
    steps = json.loads((tmp_path / "saved" / "policy_preprocessor.json").read_text())["steps"]
    assert [step["config"]["enabled"] for step in steps if "class" in step] == [True]


# --- what is left over, and what is refused -----------------------------------------------------------------------


@settings(max_examples=30)
@given(rows=st.integers(0, 5), padding=st.integers(0, 3), batched=st.booleans(), seed=st.integers(0, 99))
def test_left_over_actions_are_moved_and_padding_is_not(rows, padding, batched, seed):
    random = torch.Generator().manual_seed(seed)
    anchor = torch.randn(1, 4, generator=random)
    left_over = torch.cat([torch.randn(rows, 4, generator=random), torch.zeros(padding, 4)])
    given_rows = left_over[None] if batched else left_over
    moved = relative_to(anchor, given_rows)
    assert moved.shape == given_rows.shape
    moved = moved[0] if batched else moved
    torch.testing.assert_close(moved[:rows], left_over[:rows] - anchor)
    assert not moved[rows:].any()


def test_processors_and_policy_that_disagree_are_refused(loaded):
    batch = loaded.preprocess(observe(0))
    policy = redraw(PI05GeometryPolicy(relative_config(use_relative_actions=False))).eval()
    with pytest.raises(ValueError, match=r"processors make actions relative.*use_relative_actions=false"):
        policy.select_action(batch)
    del batch[ACTION_ANCHOR]
    with pytest.raises(ValueError, match="use_relative_actions=true, but its processors do not"):
        loaded.policy.select_action(batch)
    batch |= {"action": torch.randn(1, CHUNK, len(JOINTS))}
    with pytest.raises(ValueError, match="use_relative_actions=true, but its processors do not"):
        loaded.policy.forward(batch)


def test_lerobots_own_steps_do_not_pass_unnoticed(loaded):
    """Those of a checkpoint of an earlier version: they add the state of the wrong tick."""
    relative = RelativeActionsProcessorStep(True, ["gripper"], JOINTS)
    steps = [relative if type(s).__name__ == "relative_actions_processor" else s for s in loaded.preprocess.steps]
    preprocess = PolicyProcessorPipeline(steps)
    AbsoluteActionsProcessorStep(True, relative)
    with pytest.raises(ValueError, match="its processors do not make actions relative"):
        loaded.policy.select_action(preprocess(observe(0)))


def test_relative_actions_need_a_state_dimension_for_each_action(checkpoint):
    preprocess = load_policy(checkpoint).preprocess
    batch = observe(0) | {"action": torch.zeros(1, CHUNK, len(JOINTS))}
    batch[STATE] = batch[STATE][:, :3]
    with pytest.raises(ValueError, match=r"each of the 4 action dimensions, but observation.state has 3"):
        preprocess(batch)
    del batch[STATE]
    with pytest.raises(ValueError, match=r"relative to observation.state, which is missing"):
        preprocess(batch)


def test_a_relative_dimension_that_mean_and_deviation_cannot_carry_is_refused():
    mapping = {"STATE": NormalizationMode.QUANTILES, "ACTION": NormalizationMode.MEAN_STD}
    stats = action_stats(mean=torch.zeros(4), std=torch.tensor([1.0, 0.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match=r"relative action\[1\] have a standard deviation of 0"):
        make_pi05_geometry_pre_post_processors(relative_config(normalization_mapping=mapping), stats)
