"""openpi's websocket protocol: one session per connection, one request of it at a time.

The event loop only reads, checks and writes frames; what computes is the worker's thread. So keepalives are answered however
long a chunk takes.
"""

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Callable
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from .admission import Admission
from .bounded_connection import BoundedConnection
from .engine import make_job, note_answer
from .inputs import Inputs
from .limits import BusyError, Limits, RequestError
from .session import Session
from .wire import decode, encode
from .worker import BatchWorker

logger = logging.getLogger(__name__)


class WebsocketServer:
    """Serves a worker's policy. metadata: what every client is told first. seed, noise_shape: of the requests' noise."""

    def __init__(
        self,
        worker: BatchWorker,
        inputs: Inputs,
        limits: Limits,
        metadata: dict[str, Any],
        seed: int,
        noise_shape: tuple[int, int],
        key: str | None = None,
    ) -> None:
        self._worker, self._inputs, self._limits = worker, inputs, limits
        self._metadata, self._seed, self._noise_shape = metadata, seed, noise_shape
        self._admission = Admission(key, self._why_full, self._why_ill)
        self._sessions: set[str] = set()
        self._answering = 0
        self._draining = False

    async def run(
        self,
        host: str,
        port: int,
        stop: asyncio.Event,
        listening: Callable[[int], None] = lambda port: None,
        *,
        drain_seconds: float = 60.0,
        keepalive: float = 20.0,
    ) -> None:
        """Serve until `stop` is set; then finish what is being answered, at most drain_seconds.

        listening: called with the port once it is open; 0 chooses one. keepalive: seconds between pings, and to an answer.
        Raises what warming up raises.
        """
        try:
            async with serve(
                self._handle,
                host,
                port,
                process_request=self._admission,
                create_connection=BoundedConnection,
                compression=None,  # a compressed frame may be a thousand times its size
                max_size=self._limits.frame_bytes,
                max_queue=1,
                ping_interval=keepalive,
                ping_timeout=keepalive,
                server_header=None,
            ) as server:
                listening(server.sockets[0].getsockname()[1])
                self._worker.start()
                warm = asyncio.ensure_future(asyncio.to_thread(self._worker.wait_until_warm))
                stopped = asyncio.ensure_future(stop.wait())
                try:
                    await asyncio.wait({warm, stopped}, return_when=asyncio.FIRST_COMPLETED)
                    if warm.done():
                        warm.result()
                        logger.info("Warm: requests are answered.")
                    await stopped
                finally:
                    stopped.cancel()
                    warm.cancel()  # it is still waited for if the signal came first
                await self._drain(drain_seconds)
        finally:
            await asyncio.to_thread(self._worker.close)

    async def _drain(self, seconds: float) -> None:
        self._draining = True
        logger.info("Shutting down: %d requests are still answered.", self._answering)
        end = time.monotonic() + seconds
        while self._answering and time.monotonic() < end:
            await asyncio.sleep(0.02)

    def _why_ill(self) -> str | None:
        """Why requests are not answered."""
        if self._draining:
            return "The server is shutting down."
        return None if self._worker.healthy else "The server is warming up, or its policy fails."

    def _why_full(self) -> str | None:
        """Why no session can begin now."""
        if self._draining:
            return "The server is shutting down."
        if len(self._sessions) >= self._limits.sessions:
            return f"The server has {self._limits.sessions} sessions already."
        return None

    async def _handle(self, connection: ServerConnection) -> None:
        session = Session()
        self._sessions.add(session.name)
        logger.info("Session %s begins.", session.name)
        try:
            # A connection that breaks ends its own session only.
            with contextlib.suppress(ConnectionClosed):
                await connection.send(encode(self._metadata | {"session": session.name}))
                await self._converse(connection, session)
        finally:
            self._sessions.discard(session.name)
            logger.info("Session %s ends after %d chunks.", session.name, session.requests)

    async def _converse(self, connection: ServerConnection, session: Session) -> None:
        previous: float | None = None
        async for frame in connection:
            start = time.perf_counter()
            self._answering += 1
            try:
                try:
                    reply = await self._reply(connection, session, frame)
                except BusyError as error:  # another attempt may succeed: the client connects again
                    logger.info("Session %s: %s", session.name, error)
                    await connection.close(CloseCode.TRY_AGAIN_LATER, str(error))
                    return
                if isinstance(reply, dict) and previous is not None and "server_timing" in reply:
                    reply["server_timing"]["prev_total_ms"] = previous
                await connection.send(encode(reply) if isinstance(reply, dict) else reply)
            finally:
                self._answering -= 1
            previous = (time.perf_counter() - start) * 1e3

    async def _reply(self, connection: ServerConnection, session: Session, frame: str | bytes) -> dict[str, Any] | str:
        """What is sent back: a map, or a text, which is how this protocol says that something is wrong.

        Raises BusyError if the server takes no request now.
        """
        try:
            if isinstance(frame, str):
                raise RequestError("Requests are msgpack maps in binary frames; this was a text frame.")
            if self._draining:
                raise BusyError("The server is shutting down.")
            message = decode(frame, self._limits)
            endpoint = message.pop("endpoint", "infer")
            if endpoint == "reset":
                session.rig = self._inputs.rigs.take(message, session.rig)
                session.reset()
                return {"status": "reset", "session": session.name, "episode": session.episode}
            if endpoint != "infer":
                raise RequestError("endpoint must be infer or reset.")
            return await self._infer(connection, session, message)
        except (BusyError, ConnectionClosed):
            raise
        except RequestError as error:
            logger.info("Session %s: %s", session.name, error)
            return str(error)
        except Exception:  # what went wrong is for the log; the client is told where to look
            number = secrets.token_hex(4)
            logger.exception("Error %s in session %s.", number, session.name)
            return f"The server failed on this request; its log says why under error {number}."

    async def _infer(self, connection: ServerConnection, session: Session, message: dict[str, Any]) -> dict[str, Any]:
        request = self._inputs.read(message, session.seen, session.rig)
        waiting = self._worker.submit(make_job(session, request, self._seed, self._noise_shape))
        future = asyncio.ensure_future(asyncio.wrap_future(waiting))
        gone = asyncio.ensure_future(connection.wait_closed())
        try:
            await asyncio.wait({future, gone}, return_when=asyncio.FIRST_COMPLETED)
            if not future.done():
                future.cancel()  # nobody waits for this chunk: it is not computed, if it has not begun
                raise RequestError("The client has gone.")
            answer = future.result()
        finally:
            gone.cancel()
        number = session.requests
        note_answer(session, request, answer)
        return {
            "actions": answer.actions,
            "session": session.name,
            "episode": session.episode,
            "request": number,
            "server_timing": {"infer_ms": answer.infer_ms, "queue_ms": answer.queue_ms, "batch": answer.batch},
            "policy_timing": {"infer_ms": answer.infer_ms},
        }
