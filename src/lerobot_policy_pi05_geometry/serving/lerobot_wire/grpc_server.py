"""LeRobot's protocol of asynchronous inference: Ready, SendPolicyInstructions, then SendObservations and GetActions in turn.

A session per client, by its address. The policy is the one that is served, whatever a client names. LeRobot's client cannot send
a key and does not encrypt, so this listens on loopback only; from another machine it is reached through an SSH tunnel.

A client whose connection was dropped has another address afterwards, and says what its robot is only when it is started. If it
was the only one, it continues in a new session; among several it cannot be told which one it was, and it is refused.
"""

import logging
import pickle
import secrets
import signal
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NoReturn

import grpc
import torch
from lerobot.async_inference.helpers import TimedAction
from lerobot.transport import services_pb2, services_pb2_grpc

from ...checkpoint.load import load_policy
from ..engine import make_job, note_answer
from ..inputs import Request
from ..keys import is_loopback
from ..limits import MIB, BusyError, FailedError, RequestError
from ..service import Service, make_service
from ..session import Session
from .observation import Robot, read_observation, read_robot
from .pickles import read_pickle

logger = logging.getLogger(__name__)

_MESSAGE_BYTES = 4 * MIB  # robot_client sends an observation in pieces of 2 MiB
_INSTRUCTION_BYTES = 1 * MIB
_CLIENTS = 16  # each holds up to two threads: one sends, one waits for actions
_SENDING = 30.0  # seconds that an observation may take to arrive; its call holds a thread
_GONE = 1.0  # seconds without a call in progress, after which a client is gone: it asks for actions all the time
_WAIT = 2.0  # seconds that GetActions waits for an observation, before it answers with nothing


@dataclass
class _Client:
    """What is kept of one robot_client. calls: how many are in progress. heard: when the last one ended."""

    calls: int = 0
    heard: float = field(default_factory=time.monotonic)
    session: Session = field(default_factory=Session)
    robot: Robot | None = None
    changed: threading.Condition = field(default_factory=threading.Condition)
    latest: tuple[Request, float, int] | None = None  # an observation that waits, its time and its step
    asking: threading.Lock = field(default_factory=threading.Lock)
    sending: threading.Lock = field(default_factory=threading.Lock)
    answered: deque[int] = field(default_factory=lambda: deque(maxlen=1000))  # steps

    @property
    def gone(self) -> bool:
        return not self.calls and time.monotonic() - self.heard > _GONE


class LeRobotServicer(services_pb2_grpc.AsyncInferenceServicer):
    """The four calls. fps: the robots' control rate, which spaces the timestamps of a chunk. seed: of the noise."""

    def __init__(self, service: Service, seed: int, fps: float) -> None:
        self._service, self._seed, self._period = service, seed, 1.0 / fps
        self._clients: OrderedDict[str, _Client] = OrderedDict()
        self._lock = threading.Lock()

    def Ready(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        with self._lock:
            self._clients[context.peer()] = _Client()
            self._clients.move_to_end(context.peer())
            while (
                len(self._clients) > _CLIENTS
            ):  # gRPC does not tell who has gone: the one silent for longest makes room
                self._clients.popitem(last=False)
        return services_pb2.Empty()

    def SendPolicyInstructions(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        client = self._client(context)
        try:
            if len(request.data) > _INSTRUCTION_BYTES:
                raise RequestError(f"Policy instructions have at most {_INSTRUCTION_BYTES} bytes.")
            told = read_pickle(request.data, self._service.limits)
            client.robot = read_robot(told, self._service.inputs, self._service.engine.config.chunk_size)
        except RequestError as error:
            _refuse(context, error)
        return services_pb2.Empty()

    def SendObservations(self, request_iterator: Iterator[Any], context: grpc.ServicerContext) -> Any:  # noqa: N802
        client = self._client(context)
        if not client.sending.acquire(blocking=False):
            _refuse(context, BusyError("One call of SendObservations at a time."))
        late = threading.Timer(_SENDING, context.cancel)
        late.daemon = True
        late.start()
        try:
            if client.robot is None:
                raise RequestError("Send policy instructions first.")
            told = read_pickle(self._assemble(request_iterator), self._service.limits)
            observation = read_observation(told, client.robot)
            request = self._service.inputs.read(observation.message, client.session.seen)
        except RequestError as error:
            _refuse(context, error)
        finally:
            late.cancel()
            client.sending.release()
        with client.changed:
            if observation.must_go or observation.timestep not in client.answered:
                client.latest = request, observation.timestamp, observation.timestep  # an older one is out of date
                client.changed.notify()
        return services_pb2.Empty()

    def GetActions(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        client = self._client(context)
        if not client.asking.acquire(blocking=False):
            _refuse(context, BusyError("One call of GetActions at a time."))
        try:
            with client.changed:
                if not client.changed.wait_for(lambda: client.latest is not None, _WAIT):
                    return services_pb2.Actions(data=b"")  # LeRobot's way to say that there is nothing
                assert client.latest is not None
                (request, when, step), client.latest = client.latest, None
                client.answered.append(step)
            return services_pb2.Actions(data=self._actions(client, request, when, step))
        except RequestError as error:
            _refuse(context, error)
        finally:
            client.asking.release()

    def _actions(self, client: _Client, request: Request, when: float, step: int) -> bytes:
        service, session = self._service, client.session
        job = make_job(session, request, self._seed, service.engine.noise_shape)
        try:
            answer = service.worker.submit(job).result()
        except RequestError:
            raise
        except Exception as error:  # what went wrong is for the log; the client is told where to look
            number = secrets.token_hex(4)
            logger.exception("Error %s in session %s.", number, session.name)
            raise FailedError(f"The server failed on this request; its log says why under error {number}.") from error
        note_answer(session, request, answer)
        assert client.robot is not None
        actions = [
            TimedAction(timestamp=when + i * self._period, timestep=step + i, action=torch.from_numpy(action))
            for i, action in enumerate(answer.actions[: client.robot.actions].copy())
        ]
        return pickle.dumps(actions)  # written here, read by the client; nothing from outside is in it

    def _assemble(self, pieces: Iterator[Any]) -> bytes:
        """The bytes of an observation, of which no more are kept than are allowed."""
        whole, limit = bytearray(), self._service.limits.frame_bytes
        for piece in pieces:
            if piece.transfer_state == services_pb2.TRANSFER_BEGIN:
                whole.clear()
            whole += piece.data
            if len(whole) > limit:
                raise RequestError(f"The observation has more than {limit} bytes.")
            if piece.transfer_state == services_pb2.TRANSFER_END:
                return bytes(whole)
        raise RequestError("The observation has no end.")

    def _client(self, context: grpc.ServicerContext) -> _Client:
        with self._lock:
            client = self._clients.get(context.peer()) or self._returned(context)
            if client is not None:
                client.calls += context.add_callback(
                    partial(self._end_call, client)
                )  # True, unless it has ended already
                self._clients.move_to_end(context.peer())
        if client is None:
            context.abort(
                grpc.StatusCode.FAILED_PRECONDITION, "This client is not known here; start robot_client again."
            )
        assert client is not None
        return client

    def _end_call(self, client: _Client) -> None:
        with self._lock:
            client.calls, client.heard = client.calls - 1, time.monotonic()

    def _returned(self, context: grpc.ServicerContext) -> _Client | None:
        """The only robot, in a new session, if its connection was dropped; None if this is someone else."""
        clients = list(self._clients.values())
        if len(clients) != 1 or clients[0].robot is None or not clients[0].gone:
            return None
        logger.warning("The robot_client was lost; %s continues as its robot, in a new session.", context.peer())
        self._clients.clear()
        self._clients[context.peer()] = _Client(robot=clients[0].robot)
        return self._clients[context.peer()]


def _refuse(context: grpc.ServicerContext, error: RequestError) -> NoReturn:
    codes = {BusyError: grpc.StatusCode.RESOURCE_EXHAUSTED, FailedError: grpc.StatusCode.INTERNAL}
    context.abort(codes.get(type(error), grpc.StatusCode.INVALID_ARGUMENT), str(error))
    raise AssertionError("abort raises")


def require_loopback(host: str) -> None:
    """Raise ValueError for a host that others can reach."""
    if not is_loopback(host):
        raise ValueError(
            f"LeRobot's robot_client can send no key, so --host {host} would serve everyone; listen on 127.0.0.1, and reach "
            "it from the robot's computer by `ssh -L 8080:localhost:8080 <this machine>`."
        )


class LeRobotServer:
    """The servicer on a port. The service's worker runs from `start` to `stop`."""

    def __init__(self, service: Service, host: str, port: int, seed: int, fps: float) -> None:
        """Raises ValueError for a host that others reach or a rig that is not said, RuntimeError if the port is taken."""
        require_loopback(host)
        rigs = service.inputs.rigs
        if rigs.ids and rigs.default is None:
            raise ValueError(
                f"The checkpoint was trained on the rigs {', '.join(map(str, rigs.ids))}, and robot_client cannot say which one "
                "its robot is; say it with --rig."
            )
        self._worker = service.worker
        self._server = grpc.server(
            ThreadPoolExecutor(2 * _CLIENTS + 2, thread_name_prefix="grpc"),
            options=[("grpc.max_receive_message_length", _MESSAGE_BYTES + MIB // 16), ("grpc.so_reuseport", 0)],
        )
        services_pb2_grpc.add_AsyncInferenceServicer_to_server(LeRobotServicer(service, seed, fps), self._server)
        self.port = self._server.add_insecure_port(f"[{host}]:{port}" if ":" in host else f"{host}:{port}")

    def start(self) -> None:
        """Warm up, then listen. Raises what warming up raises."""
        self._worker.start()
        self._worker.wait_until_warm()
        self._server.start()

    def stop(self, drain_seconds: float = 60.0) -> None:
        """Finish what is being answered."""
        self._server.stop(drain_seconds).wait()
        self._worker.close()


def serve_lerobot(
    checkpoint: str,
    device: str,
    host: str,
    port: int,
    sizes: Sequence[int] | None,
    seed: int,
    fps: float,
    listening: Callable[[int], None],
    rig: int | None = None,
) -> None:
    """Serve a checkpoint to robot_clients until SIGTERM or SIGINT."""
    if not fps > 0:
        raise ValueError(f"--fps must be above 0, got {fps}.")
    require_loopback(host)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    server = LeRobotServer(make_service(load_policy(checkpoint, device), sizes, rig=rig), host, port, seed, fps)
    server.start()
    listening(server.port)
    stop.wait()
    server.stop()
