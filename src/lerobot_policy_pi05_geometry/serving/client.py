"""The client's end of openpi's protocol, with timeouts. A connection on which anything went wrong is never used again."""

import time
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from .limits import Limits, RequestError
from .wire import decode, encode


class ServerLostError(ConnectionError):
    """The server cannot be reached, or has not answered in time."""


class RefusedError(RuntimeError):
    """The server has refused a request or the key; its message is the server's sentence."""


class PolicyClient:
    """One session of a server. url: ws:// or wss://. timeout: seconds for connecting, and for every answer."""

    def __init__(self, url: str, key: str | None = None, timeout: float = 10.0, limits: Limits | None = None) -> None:
        self._url, self._timeout, self._limits = url, timeout, limits or Limits()
        headers = None if key is None else {"Authorization": f"Api-Key {key}"}
        try:
            self._connection: ClientConnection | None = connect(
                url,
                additional_headers=headers,
                compression=None,
                max_size=self._limits.frame_bytes,
                open_timeout=timeout,
                close_timeout=1.0,
            )
        except InvalidStatus as error:
            body = (error.response.body or b"").decode("utf-8", "replace").strip()
            if error.response.status_code == 503:  # it is busy or shutting down: another attempt may succeed
                raise ServerLostError(f"{url} takes no session now: {body}") from error
            raise RefusedError(f"{url} refuses this client ({error.response.status_code}): {body}") from error
        except (OSError, InvalidHandshake, ConnectionClosed) as error:  # a timeout is an OSError
            raise ServerLostError(f"{url} cannot be reached: {error or type(error).__name__}.") from error
        self.metadata = self.receive()
        self.session: str = self.metadata.get("session", "")

    def infer(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request: `actions` (S, A) float32, and timings.

        Raises RefusedError with the server's sentence, ServerLostError after a timeout or if the connection broke.
        """
        self.send(request)
        return self.receive()

    def reset(self) -> None:
        """A new episode."""
        self.infer({"endpoint": "reset"})

    def send(self, request: dict[str, Any]) -> None:
        """Send a request, whose answer `receive` waits for."""
        connection, frame = self._open, encode(request)
        try:
            connection.send(frame)
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise ServerLostError(f"The connection to {self._url} broke.") from error

    def receive(self, deadline: float | None = None) -> dict[str, Any]:
        """The next answer. deadline: of `time.monotonic`; None: the timeout from now on."""
        left = self._timeout if deadline is None else max(deadline - time.monotonic(), 0.0)
        connection = self._open
        try:
            frame = connection.recv(timeout=left)
        except TimeoutError as error:
            self.close()  # so that the late answer is never taken for another request's
            raise ServerLostError(f"{self._url} has not answered within {self._timeout:g} s.") from error
        except ConnectionClosed as error:
            self.close()
            why = "" if error.rcvd is None else error.rcvd.reason
            raise ServerLostError(f"The connection to {self._url} broke{': ' + why if why else '.'}") from error
        except OSError as error:
            self.close()
            raise ServerLostError(f"The connection to {self._url} broke.") from error
        if isinstance(frame, str):
            raise RefusedError(frame)
        try:
            return decode(frame, self._limits)
        except RequestError as error:
            self.close()
            raise ServerLostError(f"{self._url} does not speak openpi's protocol: {error}") from error

    def close(self) -> None:
        """End the session. May be called twice."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    @property
    def _open(self) -> ClientConnection:
        if self._connection is None:
            raise ServerLostError(f"The session with {self._url} has ended.")
        return self._connection
