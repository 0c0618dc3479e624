"""What the bench says of a checkpoint: every part is timed, and advice follows from what was measured."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy
from lerobot_policy_pi05_geometry.geometry.camera import Mount
from lerobot_policy_pi05_geometry.inspect.bench import PARTS, STEPS, bench, random_observation
from tests.entry_points import (
    CHUNK,
    WRIST_POSE,
    make_calibration,
    make_config,
    make_features,
    make_observation,
    make_policy,
    make_processors,
)
from tests.serving.running import make_rigs


def load(**changes) -> LoadedPolicy:
    policy = make_policy(**changes)
    return LoadedPolicy(policy, *make_processors(policy.config))


@pytest.mark.parametrize("geometry_source", ["rgbd", "random", "none"])
def test_an_observation_is_made_that_the_policy_accepts(geometry_source):
    loaded = load(geometry_source=geometry_source)
    batch = loaded.preprocess(random_observation(loaded.policy.config))
    assert loaded.policy.predict_action_chunk(batch).isfinite().all()
    if geometry_source == "rgbd":
        assert loaded.policy._measure(batch)[1].any()  # a wall is seen


def test_every_part_is_timed_and_the_parts_are_the_whole():
    result = bench(load(), make_observation(1), rounds=3)
    assert tuple(result.parts) == PARTS
    assert all(0 < part.p50 <= part.p95 for part in result.parts.values())
    assert 0 < result.chunk.p50 <= result.chunk.p95
    assert result.plain.p50 > 0
    assert list(result.steps) == list(STEPS)
    assert result.steps[3] == result.chunk  # its own number is not timed again
    assert result.explanation["runner"] == "active"


@pytest.mark.parametrize("changes", [{}, {"geometry_placement": "prefix"}, {"geometry_source": "none"}], ids=str)
def test_parts_give_the_policys_own_actions(changes):
    """The pieces that are timed are the prediction, not something like it."""
    loaded, seen = load(**changes), []
    noise = torch.randn(1, CHUNK, 8, generator=torch.Generator().manual_seed(3))
    batch = loaded.preprocess(make_observation(1))
    expected = loaded.postprocess(loaded.policy.predict_action_chunk(batch, noise=noise)[:, 0])
    loaded.policy.reset()
    observed = LoadedPolicy(loaded.policy, loaded.preprocess, lambda actions: seen.append(loaded.postprocess(actions)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "randn", lambda *_, **__: noise.clone())
        bench(observed, make_observation(1), rounds=1)
    assert len(seen) == (3 + len(STEPS) - 1) * 3  # whole, plain, parts, other steps; two rounds warm up
    for actions in seen[:9]:
        assert torch.allclose(actions, expected, atol=1e-5)


def test_advice_follows_from_the_measurement():
    result = bench(load(n_action_steps=1, inference_runner="plain"), make_observation(1), rounds=1)
    assert result.parts == {}
    assert "The runner is off (declined: inference_runner=plain" in result.advice[0]
    assert "Only 1 of 6 predicted actions" in result.advice[-1]
    assert not any("float32" in sentence for sentence in result.advice)  # of the released size alone


def test_no_round_is_no_measurement():
    with pytest.raises(ValueError, match="rounds must be at least 1, got 0"):
        bench(load(), make_observation(1), rounds=0)


def test_no_observation_is_made_up_for_a_checkpoint_without_features():
    config = load().policy.config
    config.input_features = {}
    with pytest.raises(ValueError, match=r"names no cameras and no state yet .* give --dataset.root"):
        random_observation(config)


@pytest.mark.parametrize("rig", [None, 5])
def test_a_policy_of_several_rigs_can_be_timed(rig):
    inputs, _ = make_features()
    inputs["observation.calibration.rig"] = PolicyFeature(FeatureType.STATE, (1,))
    loaded = load(calibration={}, rigs=make_rigs(None), input_features=inputs, rig=rig)
    assert bench(loaded, random_observation(loaded.policy.config), 1).chunk.p50 > 0


def test_depth_is_1_m_whatever_its_scale():
    calibration = make_calibration()
    calibration["front"].depth_scale = 1e-5
    loaded = load(calibration=calibration)
    assert bench(loaded, random_observation(loaded.policy.config), 1).chunk.p50 > 0


def test_the_pose_of_a_camera_on_an_arm_is_not_made_up():
    """Then the arm's kinematics would not be run, and not be timed."""
    calibration, (inputs, _) = make_calibration(), make_features()
    inputs.pop(WRIST_POSE)

    def made_up():
        config = make_config(calibration=calibration, input_features=dict(inputs))
        config.validate_features()
        return random_observation(config)

    assert WRIST_POSE in made_up()
    calibration["wrist"].mount = Mount("arm", "gripper", torch.eye(4).tolist())
    assert WRIST_POSE not in made_up()
