"""LeRobot's protocol: the four calls, several clients, and its unmodified robot_client as a process."""

import pickle
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import grpc
import numpy as np
import pytest
import torch
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import send_bytes_in_chunks

from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.serving.lerobot_wire import grpc_server
from lerobot_policy_pi05_geometry.serving.lerobot_wire.grpc_server import LeRobotServer
from lerobot_policy_pi05_geometry.serving.noise import request_noise
from lerobot_policy_pi05_geometry.serving.service import make_service
from tests.entry_points import ACTION_DIM, CHUNK, make_calibration, make_features, without

from .processes import POSE, logged, run, run_here, server_process
from .running import FakeEngine, fake_service, load, local_chunk, make_rigs

JOINTS = [f"joint_{i}.pos" for i in range(7)]
CAMERAS = {"front": (30, 40, 3), "front_depth": (18, 24, 1), "wrist": (28, 28, 3), "wrist_depth": (12, 12, 1)}


def load_posed(**changes):
    """A policy whose cameras' poses are all fixed."""
    inputs, outputs = make_features()
    calibration = make_calibration()
    calibration["wrist"].extrinsics = POSE
    features = without(inputs, "observation.calibration.wrist.extrinsics")
    return load(**{"calibration": calibration, "input_features": features, "output_features": outputs, **changes})


def instructions(**changes) -> RemotePolicyConfig:
    features = {"observation.state": {"dtype": "float32", "shape": (7,), "names": JOINTS}}
    for name, shape in CAMERAS.items():
        features[f"observation.images.{name}"] = {"dtype": "image", "shape": shape, "names": ["h", "w", "c"]}
    settings = {"lerobot_features": features, "actions_per_chunk": 4, "device": "cuda"}
    return RemotePolicyConfig(**{"policy_type": "act", "pretrained_name_or_path": "/etc/passwd", **settings, **changes})


def observe(step: int = 0, task: str = "push", value: float | None = None, **more) -> TimedObservation:
    random = np.random.default_rng(step)
    raw = {name: float(random.uniform(-1, 1)) if value is None else value for name in JOINTS}
    for name, shape in CAMERAS.items():
        depth = name.endswith("_depth")
        raw[name] = random.integers(300, 1800, shape, np.uint16) if depth else random.integers(0, 256, shape, np.uint8)
    return TimedObservation(100.0 + step, step, raw | {"task": task} | more, must_go=False)


class Client:
    """The calls as robot_client makes them."""

    def __init__(self, port: int) -> None:
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.use_local_subchannel_pool", 1)])
        self.stub = services_pb2_grpc.AsyncInferenceStub(self.channel)

    def begin(self, told=None) -> "Client":
        self.stub.Ready(services_pb2.Empty())
        message = pickle.dumps(instructions() if told is None else told)
        self.stub.SendPolicyInstructions(services_pb2.PolicySetup(data=message))
        return self

    def send(self, observation) -> None:
        message = observation if isinstance(observation, bytes) else pickle.dumps(observation)
        self.stub.SendObservations(send_bytes_in_chunks(message, services_pb2.Observation, silent=True))

    def actions(self) -> list:
        data = self.stub.GetActions(services_pb2.Empty()).data
        return pickle.loads(data) if data else []


@contextmanager
def serving(service, fps: float = 10.0, seed: int = 0) -> Iterator[int]:
    server = LeRobotServer(service, "127.0.0.1", 0, seed, fps)
    server.start()
    try:
        yield server.port
    finally:
        server.stop(5)


@pytest.fixture
def engine():
    return FakeEngine()


@pytest.fixture
def port(engine):
    with serving(fake_posed(engine)) as port:
        yield port
        engine.release.set()


def fake_posed(engine):
    from lerobot_policy_pi05_geometry.serving.inputs import Inputs

    service = fake_service(engine)
    loaded = load_posed()
    return service._replace(inputs=Inputs(loaded.policy.config, service.limits), engine=Sized())


class Sized:
    """What the servicer asks an engine for."""

    noise_shape = (CHUNK, 8)

    class config:  # noqa: N801
        chunk_size = CHUNK


@pytest.mark.parametrize("rig", [None, 5])
def test_a_served_chunk_is_the_local_one(monkeypatch, rig):
    """Also of a checkpoint that knows several rigs: robot_client cannot say which its robot is, so `serve --rig` does."""
    monkeypatch.setattr(secrets, "token_hex", lambda count: "robot")
    rigs = {} if rig is None else {"calibration": {}, "rigs": make_rigs(POSE)}
    loaded, served = load_posed(**rigs, rig=rig), load_posed(**rigs)
    with serving(make_service(served, (1,), rig=rig), seed=5) as port:
        client = Client(port).begin()
        for number in range(2):
            observation = observe(number)
            client.send(observation)
            actions = client.actions()
            raw = observation.observation
            request = {
                "images": {name: raw[name] for name in ("front", "wrist")},
                "depth": {name: raw[f"{name}_depth"][..., 0] for name in ("front", "wrist")},
                "extrinsics": {"wrist": np.array(POSE, np.float32)},
                "state": np.array([raw[name] for name in JOINTS], np.float32),
                "prompt": "push",
            }
            noise = request_noise(5, "robot", number, (CHUNK, 8))
            _, expected = local_chunk(loaded, [request], noise[None])
            assert torch.equal(torch.stack([a.get_action() for a in actions]), expected[0, :4])
            assert [a.get_timestep() for a in actions] == [number, number + 1, number + 2, number + 3]
            assert [a.get_timestamp() for a in actions] == pytest.approx([100 + number + 0.1 * i for i in range(4)])


def test_only_the_latest_observation_is_answered_and_none_twice(port, engine, monkeypatch):
    monkeypatch.setattr(grpc_server, "_WAIT", 0.3)
    client = Client(port).begin()
    client.send(observe(1, value=0.1))
    client.send(observe(2, value=0.2))
    assert next(a.get_timestep() for a in client.actions()) == 2
    client.send(observe(2, value=0.3))  # answered before
    start = time.monotonic()
    assert client.actions() == []
    assert time.monotonic() - start > 0.2
    repeated = observe(2, value=0.4)
    repeated.must_go = True
    client.send(repeated)
    assert client.actions()[0].get_action()[0] == pytest.approx(0.4)


def test_clients_have_sessions_of_their_own(port, engine):
    engine.delay = 0.01
    wrong = []

    def robot(i: int) -> None:
        client = Client(port).begin()
        for step in range(10):
            client.send(observe(step, value=i + step / 100))
            actions = client.actions()
            if abs(float(actions[0].get_action()[0]) - (i + step / 100)) > 1e-5 or actions[0].get_timestep() != step:
                wrong.append((i, step))

    threads = [threading.Thread(target=robot, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert not wrong
    assert sum(map(len, engine.batches)) == 60


def refused(call, code, sentence):
    with pytest.raises(grpc.RpcError, match=sentence) as caught:
        call()
    assert caught.value.code() is code
    assert "Traceback" not in caught.value.details()
    assert "secret" not in caught.value.details()


INVALID = grpc.StatusCode.INVALID_ARGUMENT


@pytest.mark.parametrize(("told", "sentence"), [
    (observe(), "Expected the policy instructions"),
    (instructions(lerobot_features=None), "do not say what the robot observes"),
    (instructions(lerobot_features={"observation.state": {"names": JOINTS[1:]}}), "6 numbers of state, but .* 7"),
    (instructions(lerobot_features={"observation.state": {"names": [1] * 7}}), "do not name the robot's joints"),
    (instructions(lerobot_features={"observation.state": {"names": JOINTS}}), "needs observation.images.front, .*no camera"),
    (instructions(actions_per_chunk=0), "actions_per_chunk must be"),
    ({"a": 1}, "Expected the policy instructions"),
    (threading.Thread, "names threading.Thread, which is none"),
])  # fmt: skip
def test_a_robot_that_does_not_fit_is_told_at_once(port, told, sentence):
    refused(lambda: Client(port).begin(told), INVALID, sentence)


def test_what_is_wrong_with_an_observation_is_told_and_others_are_served(port, engine):
    client, other = Client(port).begin(), Client(port).begin()
    for message, sentence in (
        (instructions(), "Expected an observation"),
        (observe(front=3), "front is no image"),
        (observe(front=np.zeros((30, 40, 3), np.float64)), "dtype <f8"),
        (observe(**{"joint_3.pos": "far"}), "no number joint_3.pos"),
        (observe(**{"joint_3.pos": float("nan")}), "no number joint_3.pos"),
        (observe(task=5), "must say what to do"),
        (pickle.dumps(threading.Thread), "names threading.Thread"),
        (b"junk", "no pickle"),
    ):
        refused(lambda m=message: client.send(m), INVALID, sentence)
        other.send(observe(5, value=0.5))
        other.send(TimedObservation(1.0, 5, observe(5, value=0.5).observation, must_go=True))
        assert other.actions()[0].get_action()[0] == 0.5
    client.send(observe(1, task="bad"))
    refused(client.actions, INVALID, "This observation is bad.")
    client.send(observe(2, task="broken"))
    refused(client.actions, grpc.StatusCode.INTERNAL, "its log says why under error")
    client.send(observe(3, value=0.25))
    assert client.actions()[0].get_action()[0] == 0.25


def test_the_order_of_calls(port):
    unknown = grpc.StatusCode.FAILED_PRECONDITION
    client = Client(port)
    refused(client.actions, unknown, "not known here")
    refused(lambda: client.send(observe()), unknown, "not known here")
    client.stub.Ready(services_pb2.Empty())
    refused(lambda: client.send(observe()), INVALID, "Send policy instructions first")
    client.begin()
    client.send(observe(value=1.0))
    assert len(client.actions()) == 4


def test_an_observation_that_never_ends_is_bounded(engine):
    service = fake_posed(engine)
    service = service._replace(limits=type(service.limits)(frame_bytes=2**20))
    with serving(service) as port:
        client = Client(port).begin()

        def pieces(count, end):
            for _ in range(count):
                yield services_pb2.Observation(transfer_state=services_pb2.TRANSFER_MIDDLE, data=b"x" * 2**19)
            if end:
                yield services_pb2.Observation(transfer_state=services_pb2.TRANSFER_END, data=b"x")

        refused(lambda: client.stub.SendObservations(pieces(1000, False)), INVALID, "more than 1048576 bytes")
        refused(lambda: client.stub.SendObservations(pieces(1, False)), INVALID, "has no end")


def test_an_observation_that_stops_halfway_holds_its_call_for_a_while_only(port, monkeypatch):
    monkeypatch.setattr(grpc_server, "_SENDING", 1.0)
    client, other, stop = Client(port).begin(), Client(port).begin(), threading.Event()

    def halfway():
        yield services_pb2.Observation(transfer_state=services_pb2.TRANSFER_BEGIN, data=b"x")
        stop.wait(30)

    hanging = client.stub.SendObservations.future(halfway())
    busy = grpc.StatusCode.RESOURCE_EXHAUSTED

    def second() -> None:  # the first may not have begun
        for _ in range(100):
            client.send(observe())
            time.sleep(0.01)

    refused(second, busy, "One call of SendObservations at a time")
    other.send(observe(1, value=0.5))
    assert other.actions()[0].get_action()[0] == 0.5
    with pytest.raises(grpc.RpcError):
        hanging.result(20)
    stop.set()
    end = time.monotonic() + 10
    while True:
        try:
            client.send(observe(2, value=0.25))
            break
        except grpc.RpcError:
            assert time.monotonic() < end
            time.sleep(0.05)
    assert client.actions()[0].get_action()[0] == 0.25


def test_the_client_silent_for_longest_makes_room(engine, monkeypatch):
    monkeypatch.setattr(grpc_server, "_CLIENTS", 2)
    with serving(fake_posed(engine)) as port:
        first, second = Client(port).begin(), Client(port).begin()
        first.send(observe(value=1.0))
        assert len(first.actions()) == 4
        Client(port).begin()
        first.send(observe(1, value=1.0))
        refused(lambda: second.send(observe()), grpc.StatusCode.FAILED_PRECONDITION, "not known here")


def test_the_only_client_continues_after_its_connection_was_dropped(port, engine, monkeypatch):
    """It comes from another port, and does not say again what its robot is."""
    monkeypatch.setattr(grpc_server, "_GONE", 1e6)
    before, after = Client(port).begin(), Client(port)
    before.send(observe(value=0.5))
    before.actions()
    refused(lambda: after.send(observe(1)), grpc.StatusCode.FAILED_PRECONDITION, "not known here")
    before.channel.close()
    monkeypatch.setattr(grpc_server, "_GONE", 0.0)
    for _ in range(100):  # the server may hear of the end of the last call a little later
        try:
            after.send(observe(1, value=0.25))
            break
        except grpc.RpcError:
            time.sleep(0.05)
    assert [action.get_action()[0] for action in after.actions()] == [0.25] * 4
    first, last = (batch[0] for batch in (engine.batches[0], engine.batches[-1]))
    assert last.begins
    assert not torch.equal(first.noise, last.noise)
    after.send(observe(2))
    after.actions()
    assert not engine.batches[-1][0].begins


class Call:
    """A call of a client at an address, as gRPC tells a servicer of it."""

    def __init__(self, address: str) -> None:
        self.address = address

    def peer(self) -> str:
        return self.address

    def add_callback(self, callback) -> bool:
        self.end = callback
        return True

    def abort(self, code, details):
        raise LookupError(details)


def test_a_client_whose_call_is_in_progress_is_not_gone(engine, monkeypatch):
    monkeypatch.setattr(grpc_server, "_GONE", -1.0)
    servicer = grpc_server.LeRobotServicer(fake_posed(engine), 0, 10.0)
    servicer.Ready(None, Call("a"))
    servicer.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(instructions())), started := Call("a"))
    started.end()
    asking, sending = Call("a"), Call("a")
    known = servicer._client(asking)
    assert servicer._client(sending) is known
    sending.end()
    with pytest.raises(LookupError, match="not known here"):
        servicer._client(Call("b"))
    asking.end()
    returned = servicer._client(Call("b"))
    assert returned.robot is known.robot
    assert returned.session.name != known.session.name
    with pytest.raises(LookupError, match="not known here"):
        servicer._client(Call("a"))


def test_others_cannot_reach_it(engine):
    for host in ("0.0.0.0", "::", "10.1.2.3"):
        with pytest.raises(ValueError, match="would serve everyone; listen on 127"):
            LeRobotServer(fake_posed(engine), host, 0, 0, 30.0)


def test_a_rig_that_nobody_says_is_asked_for():
    loaded = load_posed(calibration={}, rigs=make_rigs(POSE))
    with pytest.raises(ValueError, match=r"rigs 2, 5, and robot_client cannot say .* --rig"):
        LeRobotServer(make_service(loaded, (1,)), "127.0.0.1", 0, 0, 30.0)


# --- the real robot_client ----------------------------------------------------------------------------------------


def run_robot_client(run: Callable[..., str], port: int, folder: Path, actions: int) -> list[dict[str, float]]:
    printed = run(
        "lerobot.async_inference.robot_client",
        "--robot.type=simulated", "--robot.id=test", f"--robot.log={folder / 'actions.jsonl'}", f"--robot.actions={actions}",
        "--policy_type=pi05", "--pretrained_name_or_path=nobody/nothing", "--policy_device=cuda", "--actions_per_chunk=20",
        "--task=push", f"--server_address=127.0.0.1:{port}", "--chunk_size_threshold=0.5", "--fps=30",
        folder=folder,
    )  # fmt: skip
    found = logged(folder / "actions.jsonl")
    assert len(found) >= actions, printed[-3000:]
    assert all(abs(value) < 1e3 for action in found for name, value in action.items() if name != "time")
    assert len({tuple(v for k, v in action.items() if k != "time") for action in found}) > 0.9 * actions
    assert set(found[0]) == {"time", *JOINTS[:ACTION_DIM]}
    return found


@pytest.mark.train
def test_robot_client(checkpoint, tmp_path):
    """LeRobot's unmodified program."""
    with serving(make_service(load_policy(checkpoint), (1,)), fps=30.0) as port:
        run_robot_client(run_here, port, tmp_path, 60)


@pytest.mark.long
def test_robot_client_and_a_server_process(checkpoint, tmp_path):
    with server_process(checkpoint, "--lerobot", log=tmp_path / "server.log") as (port, _):
        found = run_robot_client(run, port, tmp_path, 200)
    times = np.array([action["time"] for action in found[:200]])
    print(f"{199 / (times[-1] - times[0]):.1f} actions a second")  # noqa: T201
