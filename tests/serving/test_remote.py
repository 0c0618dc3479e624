"""The remote policy: the same actions as the local one, over lost connections, in LeRobot's own programs."""

import copy
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from lerobot_policy_pi05_geometry import PI05GeometryRemoteConfig
from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.serving.client import RefusedError, ServerLostError
from lerobot_policy_pi05_geometry.serving.limits import RequestError
from lerobot_policy_pi05_geometry.serving.remote.robot_session import RobotSession, chunks_of
from lerobot_policy_pi05_geometry.serving.remote.rows import requests_of
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    FRONT_DEPTH,
    STATE,
    STATE_DIM,
    WRIST_DEPTH,
    WRIST_POSE,
    make_observation,
    without,
)

from .processes import logged, run, run_here, server_process
from .running import FakeEngine, fake_server, load, real_server, serving
from .test_inputs import make_inputs


def remote(url: str, **settings):
    config = PI05GeometryRemoteConfig(**{"server": url, "timeout": 10.0, "reconnect": 5.0, **settings})
    return get_policy_class("pi05_geometry_remote")(config)


def fake_like_real(engine: FakeEngine):
    """A server without a network that introduces itself as the real one does."""
    metadata = real_server(load())._metadata
    server = fake_server(engine)
    server._metadata = metadata
    return server


def release_later(engine: FakeEngine, seconds: float) -> None:
    """Batches take long now, and no time any more after some seconds."""
    threading.Timer(seconds, lambda: setattr(engine, "delay", 0.0)).start()


def exact(size: int = 1, seed: int = 0) -> dict:
    """An observation whose pixels are 8-bit, as cameras give them."""
    observation = make_observation(size, seed)
    for key in (FRONT, "observation.images.wrist"):
        observation[key] = (observation[key] * 255).round() / 255
    return observation


def test_it_acts_as_the_local_policy_does_bit_for_bit():
    """With noise drawn here, as a local policy draws it; over chunks and episodes, through LeRobot's processors."""
    loaded = load()
    local = copy.deepcopy(loaded.policy)

    def two_episodes(policy, act) -> torch.Tensor:
        torch.manual_seed(0)
        found = []
        for episode in range(2):
            policy.reset()
            found += [act(exact(seed=10 * episode + step)) for step in range(6)]
        return torch.stack(found)

    # Before the server starts: both use the same tokenizer, which serves one thread at a time.
    expected = two_episodes(local, lambda o: loaded.postprocess(local.select_action(loaded.preprocess(o))))
    with serving(real_server(loaded)) as running:
        policy = remote(running.url, noise="client")
        before, after = make_pre_post_processors(policy.config)
        found = two_episodes(policy, lambda o: after(policy.select_action(before(o))))
    assert expected.shape == (12, 1, ACTION_DIM)
    assert torch.equal(expected, found)


def test_rows_are_robots_with_sessions_of_their_own():
    loaded, observation = load(), exact(3)
    noise = torch.randn(3, CHUNK, 8, generator=torch.Generator().manual_seed(3))
    with serving(real_server(loaded)) as running:
        policy = remote(running.url)
        chunk = policy.predict_action_chunk(observation, noise=noise)
        assert len(running.server._sessions) == 3
        torch.manual_seed(1)
        other = policy.predict_action_chunk(observation)
        torch.manual_seed(1)
        again = policy.predict_action_chunk(observation)
    loaded.policy.reset()
    local = loaded.postprocess(loaded.policy.predict_action_chunk(loaded.preprocess(observation), noise=noise))
    torch.testing.assert_close(chunk, local, atol=1e-5, rtol=0)
    assert (other - again).abs().max() > 0.01  # the server's noise has nothing to do with this generator


def test_what_is_sent_is_small_and_loses_nothing():
    inputs = {key: {} for key in (FRONT, FRONT_DEPTH, WRIST_DEPTH, WRIST_POSE, STATE)}
    observation = exact(2) | {
        "observation.more": torch.zeros(2, 3),
        FRONT_DEPTH: make_observation(2)[FRONT_DEPTH] / 1000,
    }
    first, second = requests_of(observation, inputs)
    assert set(first) == {*inputs, "task"}
    assert (first[FRONT].dtype, first[FRONT].shape) == (np.uint8, (30, 40, 3))
    np.testing.assert_array_equal(torch.from_numpy(first[FRONT]).float() / 255, observation[FRONT][0].permute(1, 2, 0))
    assert first[FRONT_DEPTH].dtype == np.float32  # metres
    assert second[WRIST_DEPTH].dtype == np.uint16  # whole millimetres
    np.testing.assert_array_equal(second[WRIST_DEPTH], observation[WRIST_DEPTH][1].numpy())
    assert second["task"] == observation["task"][1]
    floats = requests_of(observation | {FRONT: observation[FRONT] * 0.999}, inputs)[0][FRONT]
    assert floats.dtype == np.float32
    holes = observation[WRIST_DEPTH].clone()
    holes[0, 0, 0, 0] = float("nan")
    assert requests_of(observation | {WRIST_DEPTH: holes}, inputs)[0][WRIST_DEPTH].dtype == np.float32


def test_images_of_another_scale_arrive_as_they_are_and_the_server_refuses_them():
    """Floats from 0 to 255 would be wrapped into another picture."""
    inputs = make_inputs()
    sent = requests_of(exact() | {FRONT: (exact()[FRONT] * 255).round()}, {key: {} for key in inputs.expected})[0]
    assert sent[FRONT].dtype == np.float32
    with pytest.raises(RequestError, match="outside 0 to 1"):
        inputs.read(sent)


def test_depth_of_8_bits_is_refused_as_it_is_locally():
    observation = exact() | {WRIST_DEPTH: torch.zeros(1, 1, 12, 12, dtype=torch.uint8)}
    with pytest.raises(ValueError, match=r"wrist_depth has dtype torch\.uint8, but depth must be uint16 or float"):
        requests_of(observation, {WRIST_DEPTH: {}, STATE: {}})


def test_one_task_is_every_rows():
    for task in ("pick", ["pick"], ("pick",)):
        assert [request["task"] for request in requests_of(exact(3) | {"task": task}, {STATE: {}})] == ["pick"] * 3
    with pytest.raises(ValueError, match="has 3 rows but 2 tasks; give one task, or one for each"):
        requests_of(exact(3) | {"task": ["a", "b"]}, {STATE: {}})


def test_real_time_chunking_asks_to_continue_where_the_robot_is():
    loaded = load()
    with serving(real_server(loaded)) as running:
        policy = remote(running.url, rtc_config=RTCConfig(execution_horizon=3))
        asked = []
        send = policy._sessions[0].client.send
        policy._sessions[0].client.send = lambda request: (asked.append(request), send(request))
        first = policy.predict_action_chunk(exact(), inference_delay=0, prev_chunk_left_over=None)
        assert "executed_steps" not in asked[0]
        policy.predict_action_chunk(exact(seed=1), inference_delay=2, prev_chunk_left_over=first[0, 2:5])
        assert (asked[1]["inference_delay"], asked[1]["executed_steps"], asked[1]["execution_horizon"]) == (2, 2, 3)
        policy.predict_action_chunk(exact(seed=1), inference_delay=2, prev_chunk_left_over=torch.ones(3, ACTION_DIM))
        assert "executed_steps" not in asked[2]  # it is no part of the last chunk
        with pytest.raises(RuntimeError, match="call predict_action_chunk"):
            policy.select_action(exact())


@pytest.mark.parametrize("steps", [1, 3, 9])
def test_the_place_of_a_left_over(steps):
    """LeRobot cuts it to the execution horizon, or fills it with zeros."""
    session = RobotSession(lambda: None, 0)
    chunk = torch.randn(9, 2, generator=torch.Generator().manual_seed(0))
    assert session.executed(chunk) is None
    session._last = chunk
    for start in range(9):
        left_over = torch.zeros(steps, 2)
        rest = chunk[start : start + steps]
        left_over[: len(rest)] = rest
        assert session.executed(left_over) == start
    assert session.executed(chunk[2:4] + 1) is None
    session._last = torch.ones(9, 2)
    assert torch.equal(session._last[session.executed(torch.ones(3, 2)) :][:3], torch.ones(3, 2))


def test_a_lost_server_is_reached_again_as_a_new_episode():
    engine = FakeEngine()
    with serving(fake_like_real(engine)) as first:
        policy = remote(first.url)
        policy.predict_action_chunk(exact())
        begun = policy._sessions[0].client.session
        port = first.port
        policy.config.server = "ws://127.0.0.1:1"  # nothing listens there
        first.terminate()
        first.join()
        policy.config.reconnect = policy._sessions[0]._reconnect = 0.5
        start = time.monotonic()
        with pytest.raises(ServerLostError, match="cannot be reached"):
            policy.predict_action_chunk(exact())
        assert 0.4 < time.monotonic() - start < 5
    assert port
    with serving(fake_like_real(engine)) as second:
        policy.config.server = second.url
        assert policy.predict_action_chunk(exact()).shape == (1, CHUNK, ACTION_DIM)
        assert policy._sessions[0].client.session != begun
        assert engine.batches[-1][0].begins


def test_a_server_that_comes_back_with_another_policy_is_an_error():
    """Its chunks would be of another length, its depth of another unit."""
    engine = FakeEngine()
    first, second = fake_like_real(engine), fake_like_real(engine)
    second._metadata = copy.deepcopy(first._metadata) | {"depth_unit": "m", "action_names": ["a"]}
    second._metadata["inputs"][STATE]["shape"] = [9]
    with serving(first) as running:
        policy = remote(running.url)
        policy.predict_action_chunk(exact())
    with serving(second) as running:
        policy.config.server = running.url
        said = r"\(action_names: None before, \['a'\] now, inputs: observation\.state, depth_unit: mm before, m now\)"
        for rows in (1, 2):
            with pytest.raises(ValueError, match=said):
                policy.predict_action_chunk(exact(rows))
    assert len(engine.batches) == 1


def test_a_late_chunk_is_never_used():
    engine = FakeEngine()
    with serving(fake_like_real(engine)) as running:
        policy = remote(running.url, timeout=1.0)
        engine.delay = 1.4
        release_later(engine, 1.2)
        observation = exact() | {STATE: torch.full((1, STATE_DIM), 0.5)}
        chunk = policy.predict_action_chunk(observation)  # asked twice: the first answer came too late
        assert (chunk == 0.5).all()
        chunk = policy.predict_action_chunk(exact() | {STATE: torch.full((1, STATE_DIM), 0.25)})
        assert (chunk == 0.25).all()
        assert len(engine.batches) >= 3


def test_a_reset_while_another_thread_waits_for_a_chunk_begins_an_episode():
    """LeRobot's real-time chunking asks in a thread, and resets in another one."""
    engine, found = FakeEngine(), []
    with serving(fake_like_real(engine)) as running:
        policy = remote(running.url, rtc_config=RTCConfig())
        engine.release.clear()
        thread = threading.Thread(target=lambda: found.append(policy.predict_action_chunk(exact())))
        thread.start()
        while not engine.batches:
            time.sleep(0.01)
        policy.reset()
        engine.release.set()
        thread.join(30)
        left_over = found[0][0, 2:]
        observation = exact() | {STATE: torch.full((1, STATE_DIM), 0.25)}
        chunk = policy.predict_action_chunk(observation, inference_delay=0, prev_chunk_left_over=left_over)
        assert (chunk == 0.25).all()
        job = engine.batches[-1][0]
        assert job.begins
        assert job.request.guidance is None  # the last episode's chunk is not continued
        policy.predict_action_chunk(exact())
        assert not engine.batches[-1][0].begins


class FakeClient:
    """answers: what the server answers, one after the other."""

    def __init__(self, *answers: dict):
        self.answers, self.closed = list(answers), False

    def send(self, request: dict) -> None:
        pass

    def receive(self) -> dict:
        return self.answers.pop(0)

    def close(self) -> None:
        self.closed = True


def test_an_answer_without_actions_ends_the_session():
    """What came after it would be taken for another request's answer."""
    client = FakeClient({"reset": True}, {"actions": np.zeros((2, 3), np.float32)})
    session = RobotSession(lambda: client, 0)
    session.begin({})
    with pytest.raises(ServerLostError, match="answered a request without actions"):
        session.finish()
    assert client.closed


def test_a_refusal_is_the_servers_sentence_and_leaves_the_other_rows_in_order():
    engine = FakeEngine()
    with serving(fake_like_real(engine)) as running:
        policy = remote(running.url)
        observation = exact(2) | {"task": ["bad", "go"]}
        with pytest.raises(RefusedError, match="This observation is bad"):
            policy.predict_action_chunk(observation)
        state = torch.tensor([[0.1] * STATE_DIM, [0.2] * STATE_DIM])
        chunk = policy.predict_action_chunk(observation | {"task": "go", STATE: state})
        assert torch.equal(chunk[:, 0, 0], state[:, 0])
        with pytest.raises(RefusedError, match=f"has no {FRONT}"):
            policy.predict_action_chunk(without(observation, FRONT))


class FakeSession:
    """answers: one after the other; an exception is raised."""

    def __init__(self, *answers):
        self.answers, self.taken, self.abandoned = list(answers), 0, False

    def begin(self, request):
        if isinstance(self.answers[0], KeyboardInterrupt):
            raise self.answers[0]

    def finish(self):
        self.taken += 1
        if isinstance(self.answers[0], BaseException):
            raise self.answers.pop(0)
        return self.answers.pop(0)

    def abandon(self):
        self.abandoned = True


@pytest.mark.parametrize("error", [ServerLostError("lost"), RefusedError("refused")])
def test_whatever_happens_to_one_row_no_row_gets_an_earlier_answer(error):
    sessions = [FakeSession(torch.zeros(1)), FakeSession(error), FakeSession(torch.ones(1))]
    with pytest.raises(type(error)):
        chunks_of(sessions, [{}, {}, {}])
    assert [session.taken for session in sessions] == [1, 1, 1]
    assert not any(session.abandoned for session in sessions)


def test_an_interrupt_ends_the_sessions_that_were_asked():
    sessions = [FakeSession(torch.zeros(1)), FakeSession(KeyboardInterrupt()), FakeSession(torch.ones(1))]
    with pytest.raises(KeyboardInterrupt):
        chunks_of(sessions, [{}, {}, {}])
    assert [session.abandoned for session in sessions] == [True, True, False]


@pytest.mark.parametrize(("settings", "sentence"), [
    ({"server": ""}, "needs a server"),
    ({"server": "http://x"}, "must begin with ws://"),
    ({"server": "ws://x", "noise": "none"}, "must be server or client"),
    ({"server": "ws://x", "timeout": 0.0}, "timeout must be above 0"),
    ({"server": "ws://x", "n_action_steps": 0}, "n_action_steps must be at least 1"),
])  # fmt: skip
def test_settings_that_cannot_be(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        get_policy_class("pi05_geometry_remote")(PI05GeometryRemoteConfig(**settings))


def test_a_robot_with_other_joints_is_refused():
    with serving(real_server(load())) as running:
        from lerobot.configs import FeatureType, PolicyFeature

        features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
        with pytest.raises(ValueError, match="gives 5 action dimensions, but 7 are expected"):
            remote(running.url, output_features=features)
        with pytest.raises(ValueError, match=r"n_action_steps \(7\) must not exceed the server's chunk_size \(6\)"):
            remote(running.url, n_action_steps=7)


def test_another_server_of_openpis_protocol_is_told_apart():
    with (
        serving(fake_server(FakeEngine())) as running,
        pytest.raises(ValueError, match="a server of openpi's protocol, but not `pi05-geometry serve`"),
    ):
        remote(running.url)


def test_its_configuration_is_saved_without_the_key(tmp_path, monkeypatch):
    monkeypatch.setenv("PI05_GEOMETRY_API_KEY", "k" * 32)
    PI05GeometryRemoteConfig(server="ws://x:1")._save_pretrained(tmp_path)
    assert "kkkk" not in (tmp_path / "config.json").read_text()
    assert PreTrainedConfig.from_pretrained(tmp_path).server == "ws://x:1"


# --- in LeRobot's own programs ------------------------------------------------------------------------------------


def rollout(run: Callable[..., str], port: int, engine: str, folder: Path, actions: int) -> None:
    printed = run(
        "lerobot.scripts.lerobot_rollout",
        "--robot.type=simulated", "--robot.id=test", f"--robot.log={folder / 'actions.jsonl'}", f"--robot.actions={actions}",
        "--policy.type=pi05_geometry_remote", f"--policy.server=ws://127.0.0.1:{port}",
        f"--inference.type={engine}", "--task=push", "--fps=30", "--duration=100", "--return_to_initial_position=false",
        folder=folder,
    )  # fmt: skip
    found = logged(folder / "actions.jsonl")
    assert len(found) >= actions, printed[-3000:]
    assert len({tuple(v for k, v in action.items() if k != "time") for action in found}) > 0.9 * actions
    times = np.array([action["time"] for action in found[:actions]])
    print(f"{engine}: {(len(times) - 1) / (times[-1] - times[0]):.1f} actions a second")  # noqa: T201
    assert "RTC inference error" not in printed
    assert "Traceback" not in printed


@pytest.mark.train
def test_lerobot_rollout(checkpoint, tmp_path):
    """LeRobot's unmodified program, with real-time chunking."""
    with serving(real_server(load_policy(checkpoint))) as running:
        rollout(run_here, running.port, "rtc", tmp_path, 60)


@pytest.mark.long
@pytest.mark.parametrize("engine", ["sync", "rtc"])
def test_lerobot_rollout_and_a_server_process(checkpoint, tmp_path, engine):
    with server_process(checkpoint, log=tmp_path / "server.log") as (port, _):
        rollout(run, port, engine, tmp_path, 200)
