"""The policy on a robot: chunks, the action queue, failing cameras, real-time chunking."""

import math
from functools import partial

import pytest
import torch
from lerobot.configs import RTCAttentionSchedule
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

from lerobot_policy_pi05_geometry.data.images import prepare_images
from lerobot_policy_pi05_geometry.inference.cuda_graphs import GraphRunner
from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT_DEPTH,
    GEOMETRY,
    TOKEN_MASK,
    TOKENS,
    WRIST,
    WRIST_DEPTH,
    chunk_of,
    make_batch,
    make_policy,
    without,
)
from tests.inference.tape import TapeRecorder

# --- acting -------------------------------------------------------------------------------------------------------


def test_a_chunk_has_the_shape_of_the_action_and_follows_its_noise():
    policy, batch = make_policy(), make_batch(3)
    chunk = chunk_of(policy, batch)
    assert chunk.shape == (3, CHUNK, ACTION_DIM)
    assert torch.equal(chunk_of(policy, batch), chunk)
    assert not torch.allclose(policy.predict_action_chunk(batch, noise=torch.zeros(3, CHUNK, 8)), chunk)
    assert not torch.allclose(chunk_of(policy, batch, num_steps=7), chunk)
    torch.manual_seed(3)
    drawn = policy.predict_action_chunk(batch)
    assert not torch.allclose(policy.predict_action_chunk(batch), drawn)
    torch.manual_seed(3)
    assert torch.equal(policy.predict_action_chunk(batch), drawn)


def test_actions_leave_the_queue_one_by_one_until_it_is_empty():
    policy, batch = make_policy(n_action_steps=4), make_batch(2)
    noise = torch.randn(2, CHUNK, 8)
    chunk = policy.predict_action_chunk(batch, noise=noise)
    policy.reset()
    for step in range(4):
        assert torch.equal(policy.select_action(batch, noise=noise), chunk[:, step])
    other = make_batch(2, seed=5)
    assert torch.equal(policy.select_action(other, noise=noise), policy.predict_action_chunk(other, noise=noise)[:, 0])


def test_reset_forgets_the_queue():
    policy, batch, noise = make_policy(), make_batch(2), torch.randn(2, CHUNK, 8)
    first = policy.select_action(batch, noise=noise)
    policy.reset()
    assert torch.equal(policy.select_action(batch, noise=noise), first)
    policy.reset()
    other = make_batch(2, seed=5)
    assert torch.equal(policy.select_action(other, noise=noise), policy.predict_action_chunk(other, noise=noise)[:, 0])


@pytest.mark.parametrize("act", ["select_action", "predict_action_chunk"])
def test_acting_builds_no_graph_and_leaves_training_mode(act):
    policy = make_policy().train()
    assert not getattr(policy, act)(make_batch()).requires_grad
    assert not policy.training


def test_geometry_matters():
    policy, batch = make_policy(), make_batch()
    for key in GEOMETRY:
        changed = batch | {key: make_batch(seed=7)[key]}
        assert (chunk_of(policy, changed) - chunk_of(policy, batch)).abs().max() > 1e-4, key


def test_a_depth_camera_may_fail_in_the_middle_of_an_episode(caplog):
    policy, batch = make_policy(n_action_steps=1), make_batch(1)
    policy.reset()
    policy.select_action(batch)
    for broken in (without(batch, FRONT_DEPTH), batch | {FRONT_DEPTH: torch.full_like(batch[FRONT_DEPTH], math.nan)}):
        assert policy.select_action(broken).isfinite().all()
    assert policy.select_action(without(batch, FRONT_DEPTH, WRIST_DEPTH)).isfinite().all()
    assert sum("'front'" in record.getMessage() for record in caplog.records) == 1
    noise = torch.zeros(1, CHUNK, 8)
    recovered = policy.predict_action_chunk(batch, noise=noise)
    assert torch.equal(recovered, make_policy(n_action_steps=1).predict_action_chunk(batch, noise=noise))


# --- recorded chunks ------------------------------------------------------------------------------------------------


@pytest.fixture
def recording(monkeypatch) -> None:
    """Policies act as on a GPU: chunks are recorded, by tapes instead of CUDA graphs."""
    on_tape = partial(GraphRunner, new_recorder=TapeRecorder)
    monkeypatch.setattr(ChunkSampler, "_class", lambda sampler, runner: ChunkRunner if runner == "eager" else on_tape)


@pytest.mark.parametrize("changes", [{}, {"geometry_placement": "prefix"}, {"geometry_source": "none"}], ids=str)
def test_recorded_chunks_follow_whatever_the_robot_sees(recording, changes):
    policy = make_policy(absent_cameras=[WRIST], **changes)
    sizes, blind = set(), without(make_batch(1), FRONT_DEPTH, WRIST_DEPTH)
    seen = [
        make_batch(1),
        make_batch(2),
        make_batch(1, 4),
        without(make_batch(1, 5), FRONT_DEPTH),
        blind,
        make_batch(2, 6),
    ]
    longer = {TOKENS: torch.arange(40)[None], TOKEN_MASK: torch.ones(1, 40, dtype=torch.bool)}
    for batch in [*seen, without(make_batch(1, 7), WRIST), make_batch(1, 8) | longer, make_batch(1)]:
        noise = torch.randn(len(batch[TOKENS]), CHUNK, 8)
        found = policy.predict_action_chunk(batch, noise=noise)
        expected = policy.predict_action_chunk(batch, noise=noise, runner="plain")
        assert (found - expected).abs().max() <= 1e-5
        sizes.add((len(batch[TOKENS]), batch[TOKENS].shape[1], WRIST in batch))
    said = policy.sampler.explain()
    assert said["CUDA graphs"] == f"active: {len(sizes)} of at most 8 shapes of inputs recorded"
    assert said["prompt"] == "padded to a multiple of 32 tokens, one graph each"
    assert policy.sampler.explain("eager")["prompt"] == "as long as the longest of the batch"


def test_recorded_chunks_are_declined_where_guidance_is_asked_for(recording, caplog):
    policy, batch = make_rtc_policy(), make_batch(1)
    left_over = {"prev_chunk_left_over": torch.randn(1, 4, ACTION_DIM), "inference_delay": 1, "execution_horizon": 4}
    assert policy.predict_action_chunk(batch, **left_over).isfinite().all()
    assert "real-time chunking" in caplog.text
    assert policy.sampler.explain()["runner"].startswith("declined: real-time chunking")


# --- real-time chunking -------------------------------------------------------------------------------------------


def make_rtc_policy(enabled: bool = True) -> PI05GeometryPolicy:
    config = RTCConfig(
        enabled=enabled,
        execution_horizon=4,
        prefix_attention_schedule=RTCAttentionSchedule.LINEAR,
        max_guidance_weight=5.0,
    )
    return make_policy(rtc_config=config)


def test_guided_chunks_follow_what_is_left_of_the_previous_one():
    policy, batch, noise = make_rtc_policy(), make_batch(1), torch.randn(1, CHUNK, 8)
    plain = make_policy().predict_action_chunk(batch, noise=noise, runner="plain")
    unguided = policy.predict_action_chunk(batch, noise=noise)
    assert torch.equal(unguided, plain)  # nothing is left over yet
    left_over = plain + 1.0
    guided = policy.predict_action_chunk(
        batch, noise=noise, prev_chunk_left_over=left_over, inference_delay=2, execution_horizon=4
    )
    distance, unguided_distance = (guided - left_over).abs(), (unguided - left_over).abs()
    assert (distance[:, :2] < 0.5 * unguided_distance[:, :2]).all()
    assert not guided.requires_grad


@pytest.mark.parametrize("left", [6, 3])
def test_guidance_is_lerobots(left):
    """The same as LeRobot's integrator and guidance around a network that recomputes everything at every step."""
    policy, batch, noise = make_rtc_policy(), make_batch(2), torch.randn(2, CHUNK, 8)
    left_over = torch.randn(2, left, ACTION_DIM)
    rtc = {"prev_chunk_left_over": left_over, "inference_delay": 1, "execution_horizon": 4}
    guided = policy.predict_action_chunk(batch, noise=noise, **rtc)

    plain = make_policy()
    images, masks = prepare_images(batch, plain.config, torch.device("cpu"))
    context = plain.model._context(images, masks, batch[TOKENS], batch[TOKEN_MASK], *plain._measure(batch), None)

    def velocity(x_t: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        return plain.model._velocity(*context, None, x_t, time)

    expected = euler_integrate(
        velocity, noise, 3, rtc_processor=RTCProcessor(policy.config.rtc_config), rtc_enabled=True, **rtc
    )
    torch.testing.assert_close(guided, expected[..., :ACTION_DIM], atol=1e-5, rtol=1e-5)


def test_rtc_works_on_whole_chunks():
    with pytest.raises(RuntimeError, match=r"call predict_action_chunk, not select_action"):
        make_rtc_policy().select_action(make_batch())
    assert make_rtc_policy(enabled=False).select_action(make_batch()).shape == (2, ACTION_DIM)


def test_rtc_can_be_switched_on_after_loading():
    """As LeRobot's rollout does it: set the configuration, then call `init_rtc_processor`."""
    policy = make_policy()
    assert policy.supports_rtc()
    policy.config.rtc_config = make_rtc_policy().config.rtc_config
    policy.init_rtc_processor()
    batch, noise = make_batch(1), torch.randn(1, CHUNK, 8)
    rtc = {"prev_chunk_left_over": torch.randn(1, 4, ACTION_DIM), "inference_delay": 1, "execution_horizon": 4}
    found = policy.predict_action_chunk(batch, noise=noise, **rtc)
    assert torch.equal(found, make_rtc_policy().predict_action_chunk(batch, noise=noise, **rtc))
