"""The policy on a robot: chunks, the action queue, failing cameras, real-time chunking."""

import math
import threading

import pytest
import torch
from lerobot.configs import RTCAttentionSchedule
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

from lerobot_policy_pi05_geometry import compat
from lerobot_policy_pi05_geometry.data.images import prepare_images
from lerobot_policy_pi05_geometry.inference.cuda_graphs import GraphRunner
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
from tests.inference.tape import TapeBackend

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


def test_the_numbers_of_steps_may_be_changed_on_a_built_policy():
    policy, batch, noise = make_policy(n_action_steps=2), make_batch(1), torch.randn(1, CHUNK, 8)
    three = policy.predict_action_chunk(batch, noise=noise, num_steps=3).clone()
    policy.config.num_inference_steps, policy.config.n_action_steps = 3, 4
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), three)
    taken = [policy.select_action(batch, noise=noise) for _ in range(4)]
    assert torch.equal(torch.stack(taken, dim=1), three[:, :4])


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


def record(policy: PI05GeometryPolicy) -> PI05GeometryPolicy:
    """The policy acts as on a GPU: chunks are recorded, by tapes instead of CUDA graphs."""
    policy.sampler = ChunkSampler(policy.model, TapeBackend)
    return policy


@pytest.mark.parametrize("changes", [{}, {"geometry_placement": "prefix"}, {"geometry_source": "none"}], ids=str)
def test_recorded_chunks_follow_whatever_the_robot_sees(changes):
    policy = record(make_policy(absent_cameras=[WRIST], **changes))
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


# --- real-time chunking -------------------------------------------------------------------------------------------


def make_rtc_policy(enabled: bool = True, **changes) -> PI05GeometryPolicy:
    config = RTCConfig(
        enabled=enabled,
        execution_horizon=4,
        prefix_attention_schedule=RTCAttentionSchedule.LINEAR,
        max_guidance_weight=5.0,
    )
    if compat.mode_of(config) and changes.get("rtc_mode") == "trained":
        config.mode = "trained"  # where LeRobot's configuration has the mode, ours must not contradict it
    return make_policy(rtc_config=config, **changes)


def test_guided_chunks_follow_what_is_left_of_the_previous_one():
    policy, batch, noise = make_rtc_policy(), make_batch(1), torch.randn(1, CHUNK, 8)
    plain = make_policy().predict_action_chunk(batch, noise=noise, runner="plain")
    unguided = policy.predict_action_chunk(batch, noise=noise)
    torch.testing.assert_close(unguided, plain, atol=1e-5, rtol=0)  # nothing is left over yet
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


@pytest.mark.parametrize(
    "changes", [{}, {"rtc_mode": "trained", "rtc_training_max_delay": 3}], ids=["guided", "trained"]
)
def test_real_time_chunking_is_served_by_the_runner(changes, caplog):
    """Recorded once, for chunks with and without a previous one, of any length, delay and horizon."""
    policy = record(make_rtc_policy(**changes))
    for seed, (left, delay, horizon) in enumerate([(0, None, None), (6, 2, 4), (3, 3, None), (CHUNK, 0, 2)]):
        batch, noise = make_batch(2, seed), torch.randn(2, CHUNK, 8)
        rtc = {"inference_delay": delay, "execution_horizon": horizon}
        if left:
            rtc["prev_chunk_left_over"] = torch.randn(2, left, ACTION_DIM)
        found, plain = (policy.predict_action_chunk(batch, noise=noise, runner=r, **rtc) for r in ("fast", "plain"))
        torch.testing.assert_close(found, plain, atol=1e-5, rtol=1e-5)
    assert policy.sampler.explain()["CUDA graphs"].startswith("active: 1 of")
    assert not caplog.records


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_trained_real_time_chunking_keeps_what_is_executed(steps):
    policy = make_rtc_policy(rtc_mode="trained", rtc_training_max_delay=3, num_inference_steps=steps)
    batch, noise, left = make_batch(1), torch.randn(1, CHUNK, 8), torch.randn(1, 5, ACTION_DIM)
    with_prefix, without_prefix = (
        policy.predict_action_chunk(batch, noise=noise, prev_chunk_left_over=left, inference_delay=delay)
        for delay in (2, 0)
    )
    assert torch.equal(with_prefix[:, :2], left[:, :2])
    assert ((with_prefix - without_prefix)[:, 2:].abs().amax(dim=(0, 2)) > 1e-4).all()  # all others follow it
    unguided = make_policy(num_inference_steps=steps).predict_action_chunk(batch, noise=noise)
    torch.testing.assert_close(without_prefix, unguided, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("runner", ["fast", "plain"])
def test_what_is_left_over_must_fit(runner):
    policy = make_rtc_policy(rtc_mode="trained", rtc_training_max_delay=3)
    for left, delay, says in [
        (torch.ones(1, 5, ACTION_DIM), None, "needs inference_delay"),
        (torch.ones(1, CHUNK + 1, ACTION_DIM), 1, r"T <= \d+ and A <= 8, got"),
        (torch.ones(3, 5, ACTION_DIM), 1, "B = 1"),
    ]:
        with pytest.raises(ValueError, match=says):
            policy.predict_action_chunk(make_batch(1), prev_chunk_left_over=left, inference_delay=delay, runner=runner)


@pytest.mark.parametrize("runner", ["fast", "plain"])
@pytest.mark.parametrize(("left", "delay", "kept"), [(5, 9, 3), (2, 3, 2)])
def test_one_late_chunk_does_not_end_trained_real_time_chunking(runner, left, delay, kept, caplog):
    """LeRobot gives the longest delay that it ever met, and may cut what is left below it."""
    policy = make_rtc_policy(rtc_mode="trained", rtc_training_max_delay=3)
    noise, left_over = torch.randn(1, CHUNK, 8), torch.randn(1, left, ACTION_DIM)

    def chunk(delay: int) -> torch.Tensor:
        return policy.predict_action_chunk(
            make_batch(1), noise=noise, prev_chunk_left_over=left_over, inference_delay=delay, runner=runner
        )

    expected = chunk(kept)
    assert not caplog.records
    assert torch.equal(chunk(delay), expected)
    assert torch.equal(chunk(delay), expected)
    assert [
        record.message.startswith(f"inference_delay is {delay}, but only {kept} steps") for record in caplog.records
    ] == [True]


def test_the_mode_must_be_one_the_policy_was_trained_for():
    with pytest.raises(
        ValueError, match="rtc_mode=trained needs a policy that was trained with rtc_training_max_delay"
    ):
        make_rtc_policy(rtc_mode="trained")
    with pytest.raises(ValueError, match="rtc_mode must be one of guided, trained, got 'hard'"):
        make_rtc_policy(rtc_mode="hard")
    with pytest.raises(ValueError, match="rtc_training_max_delay must be at least 0 and less than chunk_size"):
        make_policy(rtc_training_max_delay=CHUNK)


def test_debugging_takes_the_plain_path(caplog):
    """LeRobot's tracker wants every denoising step."""
    policy = make_policy(rtc_config=RTCConfig(debug=True))
    policy.predict_action_chunk(make_batch(1))
    assert "rtc_config.debug records every denoising step" in caplog.text
    assert policy.rtc_processor.get_all_debug_steps()


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


def test_a_dry_queue_leaves_no_prefix():
    """LeRobot fills what is missing of the previous chunk with zeros, which would pull the arm to the middle of its range."""
    policy, batch, noise = make_rtc_policy(), make_batch(1), torch.randn(1, CHUNK, 8)
    rtc = {"inference_delay": 2, "execution_horizon": 4}
    unguided = policy.predict_action_chunk(batch, noise=noise)
    for empty in (torch.zeros(4, ACTION_DIM), torch.zeros(1, 4, ACTION_DIM)):
        found = policy.predict_action_chunk(batch, noise=noise, prev_chunk_left_over=empty, **rtc)
        assert torch.equal(found, unguided)
    left = torch.randn(1, 1, ACTION_DIM)
    padded = torch.cat([left, torch.zeros(1, 3, ACTION_DIM)], dim=1)
    found = policy.predict_action_chunk(batch, noise=noise, prev_chunk_left_over=padded, **rtc)
    expected = policy.predict_action_chunk(
        batch, noise=noise, prev_chunk_left_over=left, inference_delay=1, execution_horizon=4
    )
    assert torch.equal(found, expected)
    assert not torch.allclose(found, unguided)
    hole = torch.cat([left, torch.zeros(1, 1, ACTION_DIM), left], dim=1)  # a zero between others is an action
    found = policy.predict_action_chunk(batch, noise=noise, prev_chunk_left_over=hole, **rtc)
    assert not torch.allclose(found, expected)


@pytest.mark.parametrize("compile_model", [True, False])
def test_compilation_is_not_asked_for_twice(compile_model):
    """As LeRobot's rollout does on --use_torch_compile=true: it sets the field, and wraps the method."""
    policy, batch, noise = make_policy(compile_model=compile_model), make_batch(1), torch.randn(1, CHUNK, 8)
    expected = policy.predict_action_chunk(batch, noise=noise)
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    policy.predict_action_chunk = torch.compile(policy.predict_action_chunk)
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), expected)
    assert torch.equal(policy.select_action(batch, noise=noise), expected[:, 0])
    assert not torch._dynamo.utils.counters["stats"]  # no graph was captured


def test_after_a_warm_up_no_prompt_is_recorded_in_an_episode():
    policy = record(make_policy(tokenizer_max_length=70))
    batch, noise = make_batch(1), torch.randn(1, CHUNK, 8)
    before = policy.predict_action_chunk(batch, noise=noise)
    policy.reset()  # warms up, since the policy has acted
    told = policy.sampler.explain()["CUDA graphs"]
    random = torch.random.get_rng_state()
    policy.warm_up()
    assert torch.equal(torch.random.get_rng_state(), random)
    for length in (5, 31, 32, 33, 64, 70):
        text = {TOKENS: torch.full((1, length), 7), TOKEN_MASK: torch.ones(1, length, dtype=torch.bool)}
        policy.predict_action_chunk(batch | text, noise=noise)
    assert policy.sampler.explain()["CUDA graphs"] == told
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), before)


def test_with_real_time_chunking_the_first_chunk_is_recorded_before_the_episode():
    policy = record(make_rtc_policy(tokenizer_max_length=70, empty_cameras=1))
    policy.reset()
    told = policy.sampler.explain()["CUDA graphs"]
    assert told.startswith("active: 3 of")
    policy.predict_action_chunk(make_batch(1))
    policy.predict_action_chunk(make_batch(1), prev_chunk_left_over=torch.ones(4, ACTION_DIM), inference_delay=1)
    assert policy.sampler.explain()["CUDA graphs"] == told


def test_a_reset_records_nothing_again(monkeypatch):
    """Also for prompts that need more recordings than are kept otherwise."""
    policy = record(make_policy(tokenizer_max_length=300))
    policy.predict_action_chunk(make_batch(1))
    policy.reset()
    recorder = policy.sampler._runners[GraphRunner]._recorder
    count = len(recorder.tapes)
    assert count >= 20  # ten lengths, two halves each
    with monkeypatch.context() as patch:
        patch.setattr(policy.sampler, "_chunk", lambda *_, **__: pytest.fail("a chunk was computed to warm up again"))
        policy.reset()
    policy.predict_action_chunk(make_batch(1))
    assert len(recorder.tapes) == count


def test_a_reset_while_a_chunk_is_computed_does_not_change_it():
    """LeRobot resets a policy while its thread for real-time chunking predicts; both use the recorded chunk's buffers."""
    policy = record(make_policy(tokenizer_max_length=32))
    batch, noise = make_batch(1), torch.randn(1, CHUNK, 8)
    expected = policy.predict_action_chunk(batch, noise=noise).clone()
    measure, reset = (
        policy._measure,
        threading.Thread(target=lambda: (policy.reset(), policy.predict_action_chunk(make_batch(1, 9)))),
    )

    def measure_slowly(batch):
        if not reset.ident:
            reset.start()
            reset.join(0.5)
        return measure(batch)

    policy._measure = measure_slowly
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), expected)
    reset.join()


@pytest.mark.parametrize("changes", [{"empty_cameras": 1}, {"absent_cameras": [WRIST]}])
def test_a_warm_up_is_for_the_cameras_that_are_there(changes):
    policy = record(make_policy(tokenizer_max_length=70, **changes))
    batch, noise = make_batch(1), torch.randn(1, CHUNK, 8)
    batch = without(batch, WRIST) if "absent_cameras" in changes else batch
    policy.predict_action_chunk(batch, noise=noise)
    policy.reset()
    told = policy.sampler.explain()["CUDA graphs"]
    for length in (5, 33, 70):
        text = {TOKENS: torch.full((1, length), 7), TOKEN_MASK: torch.ones(1, length, dtype=torch.bool)}
        policy.predict_action_chunk(batch | text, noise=noise)
    assert policy.sampler.explain()["CUDA graphs"] == told
