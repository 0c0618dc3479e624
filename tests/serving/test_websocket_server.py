"""The server on a socket: who may connect, what is answered, and what one client can do to another."""

import contextlib
import socket
import threading
import time
import urllib.error
import urllib.request

import msgpack
import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidStatus

from lerobot_policy_pi05_geometry.serving.client import PolicyClient, RefusedError, ServerLostError
from lerobot_policy_pi05_geometry.serving.keys import is_loopback, read_key, require_safe
from lerobot_policy_pi05_geometry.serving.limits import MIB, Limits
from lerobot_policy_pi05_geometry.serving.noise import request_noise
from lerobot_policy_pi05_geometry.serving.wire import decode, encode
from tests.entry_points import ACTION_DIM, CHUNK

from .running import FakeEngine, fake_server, load, local_chunk, make_request, real_server, serving
from .soak import silent
from .test_wire import mutated

KEY = "k" * 32


def connect(running, **headers):
    return websockets.sync.client.connect(
        running.url, additional_headers=headers, compression=None, max_size=None, open_timeout=10
    )


def health(running) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(running.url.replace("ws", "http") + "/healthz", timeout=5) as response:
            return response.status, response.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def mine(i: int) -> dict:
    """A request whose chunk a FakeEngine makes of `i`."""
    return make_request() | {"state": np.full(7, i, np.float32)}


@pytest.fixture
def engine():
    return FakeEngine()


@pytest.fixture
def running(engine):
    with serving(fake_server(engine)) as running:
        yield running
        engine.release.set()


# --- what is answered ---------------------------------------------------------------------------------------------


def test_a_served_chunk_is_the_local_one():
    loaded = load()
    with serving(real_server(loaded, seed=3)) as running:
        client = PolicyClient(running.url)
        assert client.metadata["protocol"] == "openpi-websocket/1"
        for number in range(2):
            request = make_request(number)
            answer = client.infer(request)
            assert (answer["session"], answer["request"], answer["episode"]) == (client.session, number, 0)
            noise = request_noise(3, client.session, number, (CHUNK, 8))
            _, actions = local_chunk(loaded, [request], noise[None])
            np.testing.assert_array_equal(answer["actions"], actions[0].numpy())
        client.close()


def test_the_metadata_says_how_to_ask():
    loaded = load(action_feature_names=[f"joint_{i}" for i in range(ACTION_DIM)])
    with serving(real_server(loaded)) as running, connect(running) as connection:
        told = msgpack.unpackb(connection.recv())
    assert (told["chunk_size"], told["action_dim"]) == (CHUNK, ACTION_DIM)
    assert told["action_names"] == [f"joint_{i}" for i in range(ACTION_DIM)]
    depth = told["inputs"]["observation.images.front_depth"]
    assert (depth["shape"], depth["dtypes"], depth["unit"], depth["required"]) == ([18, 24], ["<u2", "<f4"], "mm", True)
    assert told["inputs"]["observation.images.front"]["trained_size"] == [30, 40]
    assert told["inputs"]["observation.calibration.front.extrinsics"]["required"] is False
    assert told["inputs"]["observation.calibration.wrist.extrinsics"]["required"] is True
    assert len(told["session"]) == 16


def test_only_actions_are_an_array_and_timings_are_told(running):
    with connect(running) as connection:
        connection.recv()
        for number in range(2):
            connection.send(encode(mine(number)))
            answer = decode(connection.recv(), Limits())
            assert [name for name, value in answer.items() if isinstance(value, np.ndarray)] == ["actions"]
            assert answer["actions"].shape == (CHUNK, ACTION_DIM)
            assert answer["policy_timing"]["infer_ms"] == 1.0
            assert ("prev_total_ms" in answer["server_timing"]) == bool(number)


def test_reset_begins_an_episode(running, engine):
    client = PolicyClient(running.url)
    begins = []
    for reset in (False, False, True, False):
        if reset:
            assert client.infer({"endpoint": "reset"}) == {"status": "reset", "session": client.session, "episode": 1}
        client.infer(mine(1))
        begins.append(engine.batches[-1][0].begins)
    assert begins == [True, False, True, False]
    client.close()


def test_mistakes_are_told_in_text_and_the_session_goes_on(running):
    with connect(running) as connection:
        connection.recv()
        for frame, sentence in (
            ("hello", "this was a text frame"),
            (b"\xc1", "msgpack type 0xc1"),
            (encode({"prompt": "x"}), "has no observation.images.front"),
            (encode(mine(0) | {"endpoint": "load"}), "endpoint must be infer or reset"),
            (encode(mine(0) | {"prompt": "bad"}), "This observation is bad."),
        ):
            connection.send(frame)
            told = connection.recv()
            assert isinstance(told, str)
            assert sentence in told
            assert "\n" not in told
        connection.send(encode(mine(4)))
        assert decode(connection.recv(), Limits())["actions"][0, 0] == 4


def test_what_went_wrong_inside_is_not_told(running, caplog):
    client = PolicyClient(running.url)
    with pytest.raises(RefusedError, match="its log says why under error") as caught:
        client.infer(mine(0) | {"prompt": "broken"})
    assert "secret" not in str(caught.value)
    assert "Traceback" not in str(caught.value)
    assert str(caught.value)[-9:-1] in caplog.text
    assert "/secret/path" in caplog.text
    client.close()


# --- who may connect ----------------------------------------------------------------------------------------------


def test_the_key():
    with serving(fake_server(FakeEngine(), key=KEY)) as running:
        for headers in (
            {},
            {"Authorization": f"Api-Key {KEY}x"},
            {"Authorization": f"Api-Key {KEY[1:]}"},
            {"Authorization": f"Bearer {KEY}"},
            {"Authorization": KEY},
        ):
            with pytest.raises(InvalidStatus) as caught:
                connect(running, **headers)
            assert caught.value.response.status_code == 401
        with pytest.raises(RefusedError, match="key is missing or wrong"):
            PolicyClient(running.url, "wrong")
        PolicyClient(running.url, KEY).close()
        assert health(running)[0] == 200  # a health check has no key


def test_browsers_are_refused(running):
    for origin in ("http://localhost", "null", "https://example.org"):
        with pytest.raises(InvalidStatus) as caught:
            connect(running, Origin=origin)
        assert caught.value.response.status_code == 403


def test_only_loopback_needs_no_key(tmp_path, monkeypatch):
    for host in ("127.0.0.1", "127.0.0.2", "::1", "localhost"):
        assert is_loopback(host)
        require_safe(host, None)
    for host in ("0.0.0.0", "::", "10.0.0.1", "robot.local", "localhost.example.org", ""):
        with pytest.raises(ValueError, match="clients need a key"):
            require_safe(host, None)
        require_safe(host, KEY)
    monkeypatch.delenv("PI05_GEOMETRY_API_KEY", raising=False)
    assert read_key(None) is None
    monkeypatch.setenv("PI05_GEOMETRY_API_KEY", KEY)
    assert read_key(None) == KEY
    path = tmp_path / "key"
    path.write_text("a" * 20 + "\n")
    assert read_key(path) == "a" * 20
    for content in ("", "\n", "short", "with a\nnewline in the middle", "ä" * 20):
        path.write_text(content)
        with pytest.raises(ValueError, match="at least 16 printable"):
            read_key(path)
    with pytest.raises(FileNotFoundError, match="is not there; write a key"):
        read_key(tmp_path / "none")
    monkeypatch.setenv("PI05_GEOMETRY_API_KEY", "")  # a secret that was not mounted
    with pytest.raises(ValueError, match="at least 16 printable"):
        read_key(None)


def test_sessions_are_bounded_and_come_back():
    with serving(fake_server(FakeEngine(), limits=Limits(sessions=2))) as running:
        first, second = PolicyClient(running.url), PolicyClient(running.url)
        with pytest.raises(ServerLostError, match="has 2 sessions already"):
            PolicyClient(running.url)
        first.close()
        assert health(running)[0] == 200  # full is not ill
        while len(running.server._sessions) == 2:
            time.sleep(0.01)
        third = PolicyClient(running.url)
        assert third.infer(mine(3))["actions"][0, 0] == 3
        second.close(), third.close()


def test_sessions_are_bounded_when_many_come_at_once():
    with serving(fake_server(FakeEngine(), limits=Limits(sessions=2))) as running:
        found, barrier = [], threading.Barrier(12)

        def come() -> None:
            barrier.wait()
            with contextlib.suppress(ServerLostError):
                found.append(PolicyClient(running.url))

        threads = [threading.Thread(target=come) for _ in range(12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
        assert len(found) == len(running.server._sessions) == 2
        for client in found:
            client.close()


# --- what one client can do to another ----------------------------------------------------------------------------


def test_a_frame_that_is_too_large_is_refused_by_its_header(running):
    good = PolicyClient(running.url)
    with connect(running) as connection:
        connection.recv()
        # The header of a binary frame of 1 GiB, masked, and nothing of it.
        connection.socket.sendall(b"\x82\xff" + (2**30).to_bytes(8, "big") + b"\0\0\0\0")
        with pytest.raises(ConnectionClosed) as caught:
            connection.recv(timeout=5)
        assert caught.value.rcvd.code == 1009
    assert good.infer(mine(5))["actions"][0, 0] == 5
    good.close()


def test_half_a_frame_and_silence_end_their_own_session_only():
    with serving(fake_server(FakeEngine()), keepalive=1.0) as running:
        good = PolicyClient(running.url)
        raw = socket.create_connection(("127.0.0.1", running.port))
        raw.sendall(
            b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        assert b"101" in raw.recv(4096)
        raw.sendall(b"\x82\xff" + (MIB).to_bytes(8, "big") + b"\0\0\0\0" + b"x" * 1000)  # half, and then nothing
        raw.settimeout(30)
        end = time.monotonic() + 30
        while raw.recv(65536):  # metadata, pings, and the end: nobody answers the pings
            assert good.infer(mine(5))["actions"][0, 0] == 5
            assert time.monotonic() < end
        raw.close()
        good.close()


def test_a_flood_of_pings_ends_its_own_session_only(running):
    good, stranger = PolicyClient(running.url), silent(running.port)
    stranger.settimeout(60)
    ping = b"\x89\xfd\0\0\0\0" + b"x" * 125  # its answer is as long, and nobody reads it
    with pytest.raises((ConnectionResetError, BrokenPipeError)):  # the server has hung up
        stranger.sendall(400_000 * ping)
    assert good.infer(mine(5))["actions"][0, 0] == 5
    good.close()


@pytest.mark.parametrize("seconds", [3.5, pytest.param(45.0, marks=pytest.mark.long)])
def test_a_long_inference_loses_no_client(engine, seconds):
    """Scaled down: three keepalives long. In full: 45 s, keepalive 20 s, where openpi's own server loses its client."""
    engine.delay = seconds
    with serving(fake_server(engine), keepalive=1.0 if seconds < 10 else 20.0) as running:
        clients = [PolicyClient(running.url, timeout=4 * seconds) for _ in range(3)]
        for i, client in enumerate(clients):
            client.send(mine(i))
        assert health(running)[0] == 200  # the event loop is free meanwhile
        for i, client in enumerate(clients):
            assert client.receive()["actions"][0, 0] == i
            client.close()


def test_a_client_that_goes_is_not_computed_for(running, engine):
    engine.release.clear()
    held, gone = PolicyClient(running.url), connect(running)
    held.send(mine(1))
    gone.recv()
    while not engine.batches:
        time.sleep(0.01)
    gone.send(encode(mine(2)))
    time.sleep(0.1)
    gone.socket.shutdown(socket.SHUT_RDWR)
    time.sleep(0.2)
    engine.release.set()
    assert held.receive()["actions"][0, 0] == 1
    assert PolicyClient(running.url).infer(mine(3))["actions"][0, 0] == 3
    served = [job.request.observation["observation.state"][0] for batch in engine.batches for job in batch]
    assert served == [1, 3]


def test_a_client_that_does_not_wait_is_answered_in_order(running):
    with connect(running) as connection:
        connection.recv()
        for i in range(5):
            connection.send(encode(mine(i)))
        for i in range(5):
            assert decode(connection.recv(), Limits())["actions"][0, 0] == i


def test_others_are_served_while_one_sends_rubbish(running):
    """Mutations of a real frame, each answered by one frame: a chunk or a sentence."""
    random, real = np.random.default_rng(1), encode(mine(0))
    good = PolicyClient(running.url)
    refused = 0
    with connect(running) as connection:
        connection.recv()
        for i in range(200):
            connection.send(mutated(real, random))
            good.send(mine(i))
            told = connection.recv(timeout=30)
            refused += isinstance(told, str)
            assert isinstance(told, bytes) or ("\n" not in told and "its log says why" not in told), told
            assert good.receive()["actions"][0, 0] == i
    assert 50 < refused < 200
    good.close()


def test_many_robots_at_once_get_their_own_chunks(running, engine):
    engine.delay = 0.002
    failed = []

    def robot(i: int) -> None:
        client = PolicyClient(running.url)
        for step in range(10):
            if client.infer(mine(100 * i + step))["actions"][0, 0] != 100 * i + step:
                failed.append((i, step))
        client.close()

    threads = [threading.Thread(target=robot, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert not failed
    assert max(len(batch) for batch in engine.batches) > 1  # some were served together
    assert sum(len(batch) for batch in engine.batches) == 80


# --- beginning and end --------------------------------------------------------------------------------------------


def test_health_follows_warming_up_and_draining(engine):
    server = fake_server(engine)
    warm = threading.Event()
    server._worker._warm_up = lambda: warm.wait(5)
    with serving(server) as running:
        assert health(running)[0] == 503
        client = PolicyClient(running.url)
        client.send(mine(1))  # waits until it is warm
        warm.set()
        assert client.receive()["actions"][0, 0] == 1
        assert health(running) == (200, "OK\n")
        engine.release.clear()
        client.send(mine(2))
        while len(engine.batches) < 2:
            time.sleep(0.01)
        other = PolicyClient(running.url)
        running.terminate()
        while health(running)[0] == 200:
            time.sleep(0.01)
        assert health(running) == (503, "The server is shutting down.\n")
        with pytest.raises(ServerLostError, match="shutting down"):
            PolicyClient(running.url)
        with pytest.raises(ServerLostError, match="shutting down"):  # and no refusal: a client may connect again
            other.infer(mine(3))
        engine.release.set()
        assert client.receive()["actions"][0, 0] == 2  # what was being answered is answered
        running.join()
        with pytest.raises(ServerLostError):
            client.infer(mine(4))


def test_a_server_that_is_stopped_while_it_warms_up_ends(engine):
    server, warm = fake_server(engine), threading.Event()
    server._worker._warm_up = lambda: warm.wait(5)
    with serving(server) as running:
        running.terminate()
        while not server._draining:
            time.sleep(0.01)
        warm.set()
        running.join()
        assert running.error is None


def test_a_server_that_cannot_warm_up_ends_with_its_error(engine):
    server = fake_server(engine)

    def fail():
        raise ValueError("no kernel")

    server._worker._warm_up = fail
    with serving(server) as running:
        running.join()
        assert isinstance(running.error, ValueError)


def test_a_late_answer_is_never_anothers(running, engine):
    engine.release.clear()
    client = PolicyClient(running.url, timeout=1.0)
    with pytest.raises(ServerLostError, match=r"not answered within 1 s"):
        client.infer(mine(1))
    engine.release.set()
    with pytest.raises(ServerLostError, match="has ended"):
        client.infer(mine(2))
