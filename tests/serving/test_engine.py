"""A served chunk is the local one, alone or in company."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from lerobot.processor import RenameObservationsProcessorStep

from lerobot_policy_pi05_geometry import compat
from lerobot_policy_pi05_geometry.inference.cuda_graphs import GraphRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.serving.engine import Job, PolicyEngine, make_job, note_answer
from lerobot_policy_pi05_geometry.serving.inputs import Inputs
from lerobot_policy_pi05_geometry.serving.limits import Limits, RequestError
from lerobot_policy_pi05_geometry.serving.noise import request_noise
from lerobot_policy_pi05_geometry.serving.service import make_service
from lerobot_policy_pi05_geometry.serving.session import Session
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    WRIST,
    WRIST_DEPTH,
    WRIST_POSE,
    make_calibration,
    make_features,
    without,
)
from tests.inference.tape import TapeBackend

from .running import load, local_chunk, make_request, observation_of

SHAPE = (CHUNK, 8)


def read(loaded, request):
    return Inputs(loaded.policy.config, Limits()).read(request)


def jobs_of(loaded, requests, sessions=None):
    sessions = sessions or [Session(name=f"robot {i}") for i in range(len(requests))]
    return [make_job(s, read(loaded, r), 7, SHAPE) for s, r in zip(sessions, requests, strict=True)]


@pytest.mark.parametrize("source", ["rgbd", "none", "random"])
def test_alone_it_is_the_local_chunk_bit_for_bit(source):
    loaded = load(geometry_source=source)
    engine = PolicyEngine(loaded)
    for seed in range(2):
        request = make_request(seed)
        if source != "rgbd":
            request = {k: v for k, v in request.items() if k not in ("depth", "extrinsics")}
        (job,) = jobs_of(loaded, [request])
        (answer,) = engine.run([job], 1)
        if source != "rgbd":
            request = make_request(seed)  # what a local run is given; it looks at no depth
        chunk, actions = local_chunk(loaded, [request], job.noise[None])
        assert torch.equal(answer.chunk, chunk[0])
        np.testing.assert_array_equal(answer.actions, actions[0].numpy())
        assert answer.actions.shape == (CHUNK, ACTION_DIM)


@pytest.mark.parametrize(("size", "dtype", "far"), [(3, "float32", 1e-5), (4, "float32", 1e-5), (4, "bfloat16", 5e-2)])
def test_in_a_batch_it_is_the_local_chunk_to_rounding(size, dtype, far):
    loaded = load(dtype=dtype)
    engine, requests = PolicyEngine(loaded), [make_request(seed, f"task {seed} " * seed) for seed in range(3)]
    jobs = jobs_of(loaded, requests)
    answers = engine.run(jobs, size)
    assert [answer.batch for answer in answers] == [3, 3, 3]
    for job, request, answer in zip(jobs, requests, answers, strict=True):
        _, actions = local_chunk(loaded, [request], job.noise[None])
        np.testing.assert_allclose(answer.actions, actions[0].numpy(), atol=far, rtol=0)
    assert np.abs(answers[0].actions - answers[1].actions).max() > 0.1


def test_cameras_that_training_swapped_are_not_swapped_again():
    """A request is read under the policy's names; the preprocessor would take them for the data's."""
    loaded, request = load(), make_request()
    expected = PolicyEngine(loaded).run(jobs_of(loaded, [request]), 1)[0].chunk
    step = next(s for s in loaded.preprocess.steps if isinstance(s, RenameObservationsProcessorStep))
    step.rename_map = {FRONT: WRIST, WRIST: FRONT}
    service = make_service(loaded, (1,))
    job = make_job(Session(name="robot 0"), service.inputs.read(request), 7, SHAPE)
    assert torch.equal(service.engine.run([job], 1)[0].chunk, expected)
    assert step in loaded.preprocess.steps


def test_noise_follows_session_and_request():
    def draw(seed=0, session="a", request=0):
        return request_noise(seed, session, request, (50, 32))

    assert torch.equal(draw(), draw())
    for other in (draw(seed=1), draw(session="b"), draw(request=1)):
        assert (other - draw()).abs().mean() > 0.5
    assert abs(draw().mean()) < 0.1
    assert abs(draw().std() - 1) < 0.1


def test_noise_counts_the_requests_of_a_session_over_its_episodes():
    loaded, request = load(), make_request()
    engine, session = PolicyEngine(loaded), Session(name="robot")
    drawn = []
    for _ in range(3):
        (job,) = jobs_of(loaded, [request], [session])
        drawn.append(job.noise)
        note_answer(session, job.request, engine.run([job], 1)[0])
        session.reset()
    assert torch.equal(drawn[2], request_noise(7, "robot", 2, SHAPE))
    assert len({tuple(noise.flatten().tolist()) for noise in drawn}) == 3


def test_noise_that_the_client_sends_is_used():
    loaded, noise = load(), np.random.default_rng(0).standard_normal(SHAPE, dtype=np.float32)
    (job,) = jobs_of(loaded, [make_request() | {"noise": noise}])
    assert torch.equal(job.noise, torch.from_numpy(noise))


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("company", [False, True])
def test_real_time_chunking_continues_the_last_chunk_as_a_local_run_does(relative, company):
    loaded = load(use_relative_actions=relative)
    engine, session = PolicyEngine(loaded), Session(name="robot")
    (first,) = jobs_of(loaded, [make_request(0)], [session])
    note_answer(session, first.request, engine.run([first], 1)[0])
    last = session.chunk
    guided = make_request(1) | {"inference_delay": 2, "executed_steps": 3}
    (job,) = jobs_of(loaded, [guided], [session])
    assert job.left_over is not None
    answer = engine.run([job, job] if company else [job], 2 if company else 1)[-1]
    assert loaded.policy.rtc_processor is None  # other requests are not guided

    policy = loaded.policy
    policy.config.rtc_config = RTCConfig()
    policy.init_rtc_processor()
    left_over = last[3:]
    _, actions = local_chunk(loaded, [guided], job.noise[None], inference_delay=2, prev_chunk_left_over=left_over[None])
    np.testing.assert_allclose(answer.actions, actions[0].numpy(), atol=1e-5)
    policy.config.rtc_config = None
    policy.init_rtc_processor()
    _, free = local_chunk(loaded, [guided], job.noise[None])
    assert np.abs(answer.actions - free[0].numpy()).max() > 0.01


def test_a_new_episode_continues_nothing():
    loaded, session = load(), Session()
    engine = PolicyEngine(loaded)
    (job,) = jobs_of(loaded, [make_request()], [session])
    note_answer(session, job.request, engine.run([job], 1)[0])
    guided = make_request() | {"inference_delay": 0, "executed_steps": 1}
    assert jobs_of(loaded, [guided], [session])[0].left_over is not None
    executed = make_request() | {"inference_delay": 0, "executed_steps": CHUNK}
    assert jobs_of(loaded, [executed], [session])[0].left_over is None
    session.reset()
    assert jobs_of(loaded, [guided], [session])[0].left_over is None


def test_jobs_share_a_batch_only_with_the_same_keys_shapes_and_guidance():
    loaded = load()
    base, other = make_request(0), make_request(1)
    smaller = other | {"images": other["images"] | {"front": other["images"]["front"][1:]}}
    floats = other | {"depth": other["depth"] | {"wrist": other["depth"]["wrist"].astype(np.float32)}}
    posed = other | {"extrinsics": other["extrinsics"] | {"front": np.eye(4)}}
    same, *different = (jobs_of(loaded, [r])[0].group for r in (other, smaller, floats, posed))
    assert same == jobs_of(loaded, [base])[0].group
    assert all(group != same for group in different)


@pytest.mark.parametrize("lost", [["depth"], ["depth", "extrinsics"], ["extrinsics"]])
def test_a_camera_that_has_failed_is_masked_whoever_begins_meanwhile(lost):
    """As in a local run that has seen the camera. Another robot's episode, whose camera never measured, changes nothing."""
    loaded, session = load(), Session(name="robot")
    engine, inputs = PolicyEngine(loaded), Inputs(loaded.policy.config, Limits())
    (job,) = jobs_of(loaded, [make_request()], [session])
    note_answer(session, job.request, engine.run([job], 1)[0])
    covered = make_request(2)
    covered["depth"]["wrist"] = np.zeros_like(covered["depth"]["wrist"])
    engine.run(jobs_of(loaded, [covered]), 1)
    failed = make_request(1)
    for what in lost:
        del failed[what]["wrist"]
    job = make_job(session, inputs.read(failed, session.seen), 7, SHAPE)
    (answer,) = engine.run([job], 1)

    policy = load().policy
    batch, keys = observation_of(make_request(1)), {"depth": WRIST_DEPTH, "extrinsics": WRIST_POSE}
    with torch.no_grad():
        policy.predict_action_chunk(loaded.preprocess(batch), noise=job.noise[None])
        batch = without(batch, *(keys[what] for what in lost))
        actions = loaded.postprocess(policy.predict_action_chunk(loaded.preprocess(batch), noise=job.noise[None]))
    np.testing.assert_array_equal(answer.actions, actions[0].numpy())


def test_an_implausible_unit_is_the_requests_error_at_the_start_of_an_episode():
    loaded = load()
    engine, request = PolicyEngine(loaded), make_request()
    metres = request | {"depth": {name: array / np.float32(1000) for name, array in request["depth"].items()}}
    engine.run(jobs_of(loaded, [request]), 1)
    with pytest.raises(ValueError, match="the unit is probably wrong"):
        engine.run(jobs_of(loaded, [metres]), 1)


def test_actions_that_are_not_finite_are_never_sent():
    loaded = load()
    (job,) = jobs_of(loaded, [make_request()])
    with pytest.raises(RequestError, match="not finite"):
        PolicyEngine(loaded).run([job._replace(noise=torch.full(SHAPE, float("inf")))], 1)


def test_warming_up_runs_every_size_and_leaves_nothing_behind():
    loaded = load()
    engine, seen = PolicyEngine(loaded), []
    inputs = Inputs(loaded.policy.config, Limits())
    predict = loaded.policy.predict_action_chunk

    def note(batch, **how):
        seen.append(batch["observation.state"].shape[0])
        return predict(batch, **how)

    loaded.policy.predict_action_chunk = note
    engine.warm(inputs, (1, 2))
    assert set(seen) == {1, 2}
    (job,) = jobs_of(loaded, [make_request()])
    assert isinstance(job, Job)
    _, actions = local_chunk(loaded, [make_request()], job.noise[None])
    np.testing.assert_array_equal(engine.run([job], 1)[0].actions, actions[0].numpy())


def test_a_camera_of_rays_whose_pose_is_lost_is_masked_as_it_is_locally():
    loaded = load(geometry_source="rays")
    inputs, engine = Inputs(loaded.policy.config, Limits()), PolicyEngine(loaded)
    request = without(make_request(), "depth")
    session = Session()
    engine.run([make_job(session, inputs.read(request), 7, SHAPE)], 1)
    lost = inputs.read(without(request, "extrinsics"), seen={WRIST_POSE})
    job = make_job(session, lost, 7, SHAPE)
    (answer,) = engine.run([job], 1)
    observation = observation_of(make_request())
    loaded.policy.reset()
    loaded.policy.predict_action_chunk(loaded.preprocess(dict(observation)), noise=job.noise[None])
    local = loaded.policy.predict_action_chunk(
        loaded.preprocess(without(observation, WRIST_POSE)), noise=job.noise[None]
    )
    torch.testing.assert_close(answer.chunk, local[0], atol=1e-5, rtol=0)


def test_a_new_episode_computes_one_chunk_and_records_none(monkeypatch):
    """All robots of a batch wait for what one robot's new episode takes."""
    loaded = load()
    engine, chunks = PolicyEngine(loaded), []
    forward = loaded.policy.sampler.forward
    monkeypatch.setattr(loaded.policy.sampler, "forward", lambda *a, **k: chunks.append(1) or forward(*a, **k))
    monkeypatch.setattr(loaded.policy, "warm_up", lambda *_: pytest.fail("an episode of one robot warms up for all"))
    sessions = [Session(), Session()]
    for _ in range(2):
        engine.run(jobs_of(loaded, [make_request(0), make_request(1)], sessions), 2)
    assert len(chunks) == 2


@pytest.mark.parametrize("continues", [False, True])
def test_nothing_is_recorded_after_the_warm_up_and_nothing_dropped(continues):
    """Three sizes, two lengths of prompt, with real-time chunking and without: twelve shapes."""
    loaded = load(**({"rtc_config": RTCConfig()} if continues else {}))
    loaded.policy.sampler = ChunkSampler(loaded.policy.model, TapeBackend)
    engine, inputs = PolicyEngine(loaded), Inputs(loaded.policy.config, Limits())
    engine.warm(inputs, (1, 2, 4))
    recorded = loaded.policy.sampler._runners[GraphRunner].recorded
    assert len(recorded) == (12 if continues else 6)
    sessions = [Session() for _ in range(4)]
    for _ in range(2):
        for guided, words, size in product((False, True), (1, 6), (1, 2, 4)):
            more = {"inference_delay": 1, "executed_steps": 2} if guided else {}
            requests = [make_request(0, "warm up " * words) | more for _ in range(size)]
            jobs = jobs_of(loaded, requests, sessions[:size])
            for session, job, answer in zip(sessions, jobs, engine.run(jobs, size), strict=False):
                note_answer(session, job.request, answer)
        assert len(recorded) == 12


@dataclass
class RTCConfigOfMain(RTCConfig):
    """LeRobot's main branch has the mode in its configuration."""

    mode: str = "guided"


@pytest.mark.parametrize(
    "changes", [{"rtc_config": RTCConfigOfMain(mode="trained")}, {"rtc_mode": "trained"}], ids=["theirs", "ours"]
)
def test_trained_real_time_chunking_stays_so_in_a_server(changes, monkeypatch):
    monkeypatch.setattr(compat, "RTCConfig", RTCConfigOfMain)
    monkeypatch.setattr(compat, "RTCProcessor", lambda rtc, trained_mode_supported: RTCProcessor(rtc))
    loaded = load(rtc_training_max_delay=3, **changes)
    engine, session, modes = PolicyEngine(loaded), Session(), []
    forward = loaded.policy.sampler.forward
    monkeypatch.setattr(
        loaded.policy.sampler, "forward", lambda *a, **k: modes.append(loaded.policy.model.rtc_mode) or forward(*a, **k)
    )
    for more in ({}, {"inference_delay": 2, "executed_steps": 3}):
        (job,) = jobs_of(loaded, [make_request() | more], [session])
        (answer,) = engine.run([job], 1)
        left_over = None if session.chunk is None else session.chunk[3:5]
        note_answer(session, job.request, answer)
    assert modes[-1] == "trained"
    torch.testing.assert_close(answer.chunk[:2], left_over)


def test_a_depth_camera_of_any_scale_can_be_warmed_up():
    calibration = make_calibration()
    calibration["front"].depth_scale = 1e-5
    loaded = load(calibration=calibration)
    PolicyEngine(loaded).warm(Inputs(loaded.policy.config, Limits()), (1,))


def test_a_colour_camera_is_one_whatever_its_name():
    """A depth map that was turned into colours stands under a depth camera's name."""
    name, (inputs, _) = "observation.images.heat_depth", make_features()
    inputs[name] = PolicyFeature(FeatureType.VISUAL, (3, 20, 20))
    loaded = load(input_features=inputs)
    request = make_request() | {name: np.full((20, 20, 3), 40, np.uint8)}
    (job,) = jobs_of(loaded, [request])
    assert torch.isfinite(PolicyEngine(loaded).run([job], 1)[0].chunk).all()
