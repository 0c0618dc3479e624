"""Source and adapter together: strict in training, and carrying on when a camera fails at inference."""

import logging
import math
from types import SimpleNamespace

import pytest
import torch

from lerobot_policy_pi05_geometry.geometry import GeometryEncoder
from lerobot_policy_pi05_geometry.geometry import encoder as module
from lerobot_policy_pi05_geometry.geometry.encoder import FIRST_CHECKED, _CameraStatus
from lerobot_policy_pi05_geometry.geometry.random_tokens import RandomSource
from lerobot_policy_pi05_geometry.geometry.rgbd import depth_key, extrinsics_key
from tests.geometry.scenes import calibrated, generator, make_source, random_observation, random_pose

CELLS = 4  # of a grid of 2


def make_encoder(*cameras: str) -> GeometryEncoder:
    """An encoder of depth cameras, for inference."""
    poses = {name: calibrated(12, 18, random_pose(generator(i))) for i, name in enumerate(cameras)}
    return GeometryEncoder(make_source(poses, 2), 16).eval()


def observe(encoder: GeometryEncoder, seed: int = 0, batch: int = 1) -> dict[str, torch.Tensor]:
    return random_observation(generator(seed), encoder.source, batch)


def failing(observation: dict[str, torch.Tensor], camera: str, how: str) -> dict[str, torch.Tensor]:
    """The observation with this camera's depth missing, all NaN or all zero."""
    depth = observation[depth_key(camera)]
    rest = {key: value for key, value in observation.items() if key != depth_key(camera)}
    if how == "missing":
        return rest
    return rest | {depth_key(camera): torch.full_like(depth, math.nan if how == "NaN" else 0.0)}


def said(caplog, level: int) -> list[str]:
    """Messages of this level so far, and forget them."""
    messages = [record.getMessage() for record in caplog.records if record.levelno == level]
    caplog.clear()
    return messages


def test_tokens_are_float32_and_stand_camera_by_camera():
    encoder = make_encoder("left", "right")
    observation = observe(encoder, batch=3)
    tokens, pad = encoder(observation)
    assert tokens.shape == (3, 2 * CELLS, 16)
    assert tokens.dtype == torch.float32
    assert torch.equal(pad, encoder.source(observation).valid.flatten(1))


def test_a_missing_camera_is_an_error_in_training():
    encoder = make_encoder("left", "right").train()
    observation = observe(encoder)
    encoder(observation)  # that it was seen before changes nothing
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) right: expected observation.images.right_depth"):
        encoder(failing(observation, "right", "missing"))
    with pytest.raises(ValueError, match=r"right_depth is all NaN in sample 0"):
        encoder(failing(observation, "right", "NaN"))


def test_the_first_observation_must_have_depth():
    encoder = make_encoder("left", "right")
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) right"):
        encoder(failing(observe(encoder), "right", "missing"))
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) left, right"):
        encoder({"observation.state": torch.zeros(1, 4)})
    encoder.reset()
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) left, right"):
        encoder({"observation.state": torch.zeros(1, 4)})


@pytest.mark.parametrize("how", ["missing", "NaN", "zero"])
def test_a_camera_that_fails_is_masked_said_once_and_used_again(how, caplog):
    caplog.set_level(logging.INFO)
    encoder = make_encoder("left", "right")
    observation = observe(encoder)
    healthy, healthy_pad = encoder(observation)
    assert not caplog.records
    for _ in range(3):
        tokens, pad = encoder(failing(observation, "right", how))
        assert not pad[:, CELLS:].any()
        assert torch.equal(pad[:, :CELLS], healthy_pad[:, :CELLS])
        assert torch.equal(tokens[:, :CELLS], healthy[:, :CELLS])
        assert tokens.isfinite().all()
    (warning,) = said(caplog, logging.WARNING)
    assert "'right'" in warning
    assert "masked" in warning
    tokens, pad = encoder(observation)
    assert torch.equal(tokens, healthy)
    assert torch.equal(pad, healthy_pad)
    (news,) = said(caplog, logging.INFO)
    assert "'right' is back" in news
    encoder(observation)
    assert not caplog.records


@pytest.mark.parametrize("how", ["missing", "NaN", "zero"])
def test_the_only_camera_may_fail_too(how, caplog):
    caplog.set_level(logging.INFO)
    encoder = make_encoder("front")
    observation = observe(encoder, batch=2)
    healthy, _ = encoder(observation)
    for _ in range(2):
        tokens, pad = encoder(failing(observation, "front", how))
        assert tokens.shape == healthy.shape
        assert tokens.isfinite().all()
        assert not pad.any()
    assert len(said(caplog, logging.WARNING)) == 1
    assert torch.equal(encoder(observation)[0], healthy)
    assert len(said(caplog, logging.INFO)) == 1
    encoder(failing(observation, "front", how))  # a second failure is said again
    assert len(said(caplog, logging.WARNING)) == 1


def test_a_camera_that_failed_in_one_way_and_then_another_failed_once(caplog):
    encoder = make_encoder("left", "right")
    observation = observe(encoder)
    encoder(observation)
    for how in ("zero", "missing", "NaN"):
        encoder(failing(observation, "left", how))
    encoder(failing(failing(observation, "left", "missing"), "right", "missing"))
    warnings = said(caplog, logging.WARNING)
    assert [name in warning for name, warning in zip(("'left'", "'right'"), warnings, strict=True)] == [True, True]


def test_a_camera_that_fails_in_one_row_of_a_batch_is_masked_and_said(caplog):
    encoder = make_encoder("front")
    observation = observe(encoder, batch=2)
    observation[depth_key("front")][1] = math.nan
    for _ in range(2):
        _, pad = encoder(observation)
        assert pad.any(dim=1).tolist() == [True, False]
    (warning,) = said(caplog, logging.WARNING)
    assert "'front' delivers no geometry in row 1 of the batch" in warning


def test_robots_in_turn_of_which_one_has_lost_a_camera_do_not_fill_the_log(caplog):
    """A server computes them as the same row."""
    caplog.set_level(logging.INFO)
    encoder = make_encoder("left", "right")
    for episode in range(2):
        encoder.reset()
        caplog.clear()
        encoder(observe(encoder))
        for request in range(5):
            encoder(failing(observe(encoder, request), "right", "missing"))
            encoder(observe(encoder, request))
        texts = [record.getMessage() for record in caplog.records]
        assert len(texts) == 3, episode
        assert all(
            f"'right' {said}" in text
            for said, text in zip(("delivers no", "is back", "fails again"), texts, strict=True)
        )


def test_what_one_episode_saw_says_nothing_about_the_next(caplog):
    """After robot A, robot B without a depth camera is refused, not masked."""
    encoder = make_encoder("left", "right")
    observation = observe(encoder)
    encoder(observation)
    encoder(failing(observation, "right", "missing"))
    encoder.reset()
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) right"):
        encoder(failing(observation, "right", "missing"))
    caplog.clear()
    encoder(failing(observation, "right", "zero"))
    assert len(said(caplog, logging.WARNING)) == 1  # a failure of the episode before is no excuse for silence


def test_values_of_a_row_are_checked_when_it_first_delivers():
    encoder = make_encoder("front")
    observation = observe(encoder, batch=2)
    dead = observation[depth_key("front")].clone()
    dead[1] = 0.0
    encoder(observation | {depth_key("front"): dead})
    wrong = observation[depth_key("front")].clone()
    wrong[1] *= 1000
    with pytest.raises(ValueError, match="unit"):
        encoder(observation | {depth_key("front"): wrong})


def test_an_optional_camera_may_be_missing_from_the_start(caplog):
    encoder = make_encoder("left", "right")
    encoder.source.optional = frozenset({"right"})
    observation = observe(encoder)
    for training in (False, True):
        encoder.train(training)
        for how in ("missing", "zero", "NaN"):
            _, pad = encoder(failing(observation, "right", how))
            assert pad[:, :CELLS].any()
            assert not pad[:, CELLS:].any()
    assert not caplog.records
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) left"):
        encoder(failing(observation, "left", "missing"))


def test_values_are_looked_into_once_an_episode():
    """Looking makes a GPU wait, so units and poses are checked on the first observation after a reset."""
    encoder = make_encoder("front")
    observation = observe(encoder)
    wrong_unit = observation | {depth_key("front"): 1000 * observation[depth_key("front")]}
    with pytest.raises(ValueError, match="unit"):
        encoder(wrong_unit)
    encoder(observation)
    encoder(wrong_unit)
    encoder.reset()
    with pytest.raises(ValueError, match="unit"):
        encoder(wrong_unit)


@pytest.mark.parametrize("optional", [(), ("wrist",)])
@pytest.mark.parametrize("training", [True, False])
def test_a_pose_that_was_never_there_is_an_error(training, optional):
    """Of an optional camera, too: its depth would count for nothing, without a word."""
    encoder = GeometryEncoder(make_source({"wrist": calibrated(12, 18)}, 2), 16).train(training)
    encoder.source.optional = frozenset(optional)
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) wrist.*observation.calibration.wrist.extrinsics"):
        encoder(observe(encoder))


@pytest.mark.parametrize("optional", [(), ("wrist",)])
@pytest.mark.parametrize("pose", ["missing", "NaN"])
def test_a_pose_that_fails_in_the_middle_of_an_episode_is_masked_like_depth(pose, optional):
    """A wrist camera without its pose measures nothing that could be placed in the base frame."""
    encoder = GeometryEncoder(make_source({"wrist": calibrated(12, 18)}, 2), 16).eval()
    encoder.source.optional = frozenset(optional)
    observation = observe(encoder) | {extrinsics_key("wrist"): random_pose(generator(3))[None].float()}
    encoder(observation)
    if pose == "missing":
        del observation[extrinsics_key("wrist")]
    else:
        observation[extrinsics_key("wrist")] = torch.full((1, 4, 4), math.nan)
    tokens, pad = encoder(observation)
    assert tokens.isfinite().all()
    assert not pad.any()


@pytest.mark.parametrize("training", [True, False])
def test_a_callers_autocast_does_not_blur_the_points(training):
    encoder = make_encoder("front").train(training)
    observation = observe(encoder)
    expected, _ = encoder(observation)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        tokens, _ = encoder(observation)
    assert torch.equal(tokens, expected)


def test_the_random_control_has_no_camera_that_could_fail():
    encoder = GeometryEncoder(RandomSource(("front",), 2), 16)
    for training in (True, False):
        tokens, pad = encoder.train(training)({"observation.state": torch.zeros(2, 4)})
        assert tokens.shape == (2, CELLS, 16)
        assert pad.all()


def test_on_a_gpu_what_was_seen_is_read_with_the_next_observation(caplog, monkeypatch):
    """As if values were on their way: nothing is said of an observation while it is being acted on."""
    caplog.set_level(logging.INFO)
    waits = []

    class Arrival:
        def synchronize(self) -> None:
            waits.append(1)

    monkeypatch.setattr(_CameraStatus, "of", lambda alive, missing: _CameraStatus(alive, Arrival(), missing))
    encoder = make_encoder("left", "right")
    observation = observe(encoder)
    encoder(observation)
    assert not waits
    _, pad = encoder(failing(observation, "right", "missing"))  # it was seen before, so this is a failure, and no error
    assert len(waits) == 1
    assert not pad[:, CELLS:].any()
    assert not caplog.records
    encoder(failing(observation, "right", "NaN"))
    assert len(said(caplog, logging.WARNING)) == 1
    encoder(observation)
    assert not caplog.records
    encoder.reset()  # the last observation of an episode is read too
    assert "'right' is back" in said(caplog, logging.INFO)[0]
    assert len(waits) == 4


def test_on_a_gpu_training_checks_values_in_its_first_batches_and_then_in_few(monkeypatch):
    """A check copies to the host, and a GPU waits for it. On a CPU nothing waits, and every batch is checked."""
    encoder = make_encoder("front").train()
    observation = observe(encoder)
    asked = []
    measure = encoder.source.forward

    def count(batch, check=True):
        asked.append(check)
        return measure(batch, check=False)

    monkeypatch.setattr(encoder.source, "forward", count)
    for _ in range(3):
        encoder(observation)
    assert asked == [True] * 3
    asked.clear()
    on_gpu = SimpleNamespace(device=SimpleNamespace(type="cuda"))
    monkeypatch.setattr(module, "batch_like", lambda batch: on_gpu)
    encoder = make_encoder("front").train()
    monkeypatch.setattr(encoder.source, "forward", count)
    for _ in range(200):
        encoder._measured(observation)
    assert asked[:FIRST_CHECKED] == [True] * FIRST_CHECKED
    assert sum(asked[FIRST_CHECKED:]) == 3
    assert all(asked[i] for i in (64, 128, 192))
