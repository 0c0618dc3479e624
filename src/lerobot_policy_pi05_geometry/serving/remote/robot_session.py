"""One robot's session with the server, over lost connections: a new connection is a new episode."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..client import PolicyClient, RefusedError, ServerLostError
from ..inputs import GUIDANCE_KEYS

logger = logging.getLogger(__name__)

_PAUSE = 0.2  # seconds between two attempts to connect
# Entries of a server's metadata that say what its policy reads and gives.
_OF_THE_POLICY = (
    "policy", "chunk_size", "n_action_steps", "action_dim", "action_names", "inputs", "depth_unit", "rigs", "default_rig",
)  # fmt: skip


class RobotSession:
    """connect: opens a session. reconnect: seconds to try for.

    One thread at a time asks for chunks, and only it uses the connection. `reset` may be called by another thread meanwhile, as
    LeRobot does.
    """

    def __init__(self, connect: Callable[[], PolicyClient], reconnect: float) -> None:
        self._connect, self._reconnect = connect, reconnect
        self._client: PolicyClient | None = None
        self._last: Tensor | None = None  # the last chunk (S, A), as it was returned
        self._request: dict[str, Any] = {}  # the last one
        self._reset_due = False

    @property
    def client(self) -> PolicyClient:
        """An open connection. Raises ServerLostError if there is none to be had in time."""
        if self._client is None:
            end = time.monotonic() + self._reconnect
            while True:
                try:
                    self._client = self._connect()
                    break
                except ServerLostError:
                    if time.monotonic() >= end:
                        raise
                    time.sleep(_PAUSE)
        return self._client

    def reset(self) -> None:
        """A new episode, of which the server is told before it is asked for the next chunk."""
        self._reset_due = bool(self._request)  # before its first request a session is new

    def begin(self, request: dict[str, Any]) -> None:
        """Send a request, whose chunk `finish` returns."""
        self._request = request
        try:
            if self._reset_due:
                self._reset_due, self._last = False, None
                if self._client is not None:  # a new connection is a new episode
                    self._client.reset()
            self.client.send(request)
        except ServerLostError as error:
            self._lose(error)

    def finish(self) -> Tensor:
        """The chunk (S, A) float32 of the request that was begun.

        If the server was lost meanwhile, it is asked once more in a new session, with no chunk to continue. Raises
        ServerLostError if it is lost again or answers without a chunk, RefusedError with its sentence.
        """
        answer = None
        if self._client is not None:
            try:
                answer = self._client.receive()
            except ServerLostError as error:
                self._lose(error)
        if answer is None:
            answer = self.client.infer({k: v for k, v in self._request.items() if k not in GUIDANCE_KEYS})
        actions = answer.get("actions")
        if not isinstance(actions, np.ndarray):
            self.abandon()
            raise ServerLostError("The server answered a request without actions, so the session was ended.")
        self._last = torch.from_numpy(actions.copy())
        return self._last

    def executed(self, left_over: Tensor) -> int | None:
        """How many actions of the last chunk come before `left_over` (T, A), which LeRobot may have cut or filled with zeros.

        None if it is no part of the last chunk, as after a lost connection. Where several positions fit, the actions there
        are equal, and the first is as good as any.
        """
        if self._last is None or self._reset_due:
            return None
        for start in range(len(self._last)):
            rest = self._last[start : start + len(left_over)]
            if torch.equal(left_over[: len(rest)], rest) and not left_over[len(rest) :].any():
                return start
        return None

    def close(self) -> None:
        if self._client is not None:
            self._client.close()

    def abandon(self) -> None:
        """End the session with whatever it still has to answer; the next request begins a new one."""
        self.close()
        self._client = self._last = None

    def _lose(self, error: ServerLostError) -> None:
        logger.warning("%s A new session begins.", error)
        self.abandon()


def require_same_policy(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise ValueError unless two metadata describe policies that read and give the same.

    The session, the server's version and its seed may differ.
    """
    changed = [key for key in _OF_THE_POLICY if before.get(key) != now.get(key)]
    if changed:
        told = ", ".join(_change(key, before, now) for key in changed)
        raise ValueError(
            f"The server has another policy than when this robot began ({told}); start the robot's "
            "program again, if that is the one to use."
        )


def _change(key: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """What of an entry differs: keys of maps, else values."""
    old, new = before.get(key), now.get(key)
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        return f"{key}: {', '.join(name for name in {**old, **new} if old.get(name) != new.get(name))}"
    return f"{key}: {old} before, {new} now"


def chunks_of(sessions: Sequence[RobotSession], requests: Sequence[dict[str, Any]]) -> list[Tensor]:
    """The chunk of every request, each in its session. Every answer is taken, or the next request would get this one's.

    Raises the first error of a session after all have answered. Anything else that ends this, such as an interrupt, ends the
    sessions that were asked.
    """
    chunks: list[Tensor] = []
    failed: Exception | None = None
    asked: list[RobotSession] = []
    try:
        for session, request in zip(sessions, requests, strict=True):
            asked.append(session)
            session.begin(request)
        for session in sessions:
            try:
                chunks.append(session.finish())
            except (RefusedError, ServerLostError) as error:
                failed = failed or error
    except BaseException:
        for session in asked:
            session.abandon()
        raise
    if failed is not None:
        raise failed
    return chunks
