"""The one thread that computes, and the queue before it.

What waits when the thread is free is served together, as far as it can share a batch; nothing waits for others to come. A batch
that fails is computed again one by one, so that one bad observation is its own client's error and nobody else's.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import NamedTuple, Protocol

from .engine import Answer, Job
from .limits import BusyError, RequestError, shown

logger = logging.getLogger(__name__)

_UNHEALTHY_AFTER = 3  # failures in a row; then warming up again decides whether the requests or the policy are to blame


class Engine(Protocol):
    """What the worker runs."""

    def run(self, jobs: Sequence[Job], size: int) -> list[Answer]: ...


class _Waiting(NamedTuple):
    job: Job
    future: "Future[Answer]"
    since: float


class BatchWorker:
    """Runs an engine's batches.

    sizes: of batches, ascending; a batch is filled up to the next of them. queue: requests that may wait. warm_up: called in
    the thread before it answers anything, and after failures, to see whether it still works.
    """

    def __init__(
        self, engine: Engine, sizes: Sequence[int], queue: int, warm_up: Callable[[], None] = lambda: None
    ) -> None:
        if not sizes or list(sizes) != sorted(set(sizes)) or sizes[0] < 1:
            raise ValueError(f"Batch sizes must be ascending numbers from 1 on, got {', '.join(map(str, sizes))}.")
        self._engine, self._sizes, self._limit = engine, tuple(sizes), queue
        self._waiting: deque[_Waiting] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._failures = 0
        self._warm_up = warm_up
        self._started: Future[None] = Future()
        self._thread = threading.Thread(target=self._serve, name="inference", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def wait_until_warm(self) -> None:
        """Raises what warming up has raised."""
        self._started.result()

    @property
    def healthy(self) -> bool:
        """Warm, and not in a row of failures that warming up has too, as of a GPU that is gone."""
        return self._started.done() and self._failures < _UNHEALTHY_AFTER and self._thread.is_alive()

    def submit(self, job: Job) -> "Future[Answer]":
        """The chunk to come. Raises BusyError if the queue is full or the worker is closing.

        The future raises RequestError for what the request is to blame for, another error for what it is not.
        """
        future: Future[Answer] = Future()
        with self._changed:
            if self._closing:
                raise BusyError("The server is shutting down.")
            if len(self._waiting) >= self._limit:
                raise BusyError(f"The server is busy: {self._limit} requests are waiting.")
            self._waiting.append(_Waiting(job, future, time.perf_counter()))
            self._changed.notify()
        return future

    def close(self) -> None:
        """Finish what waits, and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def _serve(self) -> None:
        try:
            self._warm_up()
        except Exception as error:  # handed to the one who waits for it
            self._started.set_exception(error)
            self._closing = True
            while group := self._next():
                for waiting in group:
                    waiting.future.set_exception(BusyError("The server could not start."))
            return
        self._started.set_result(None)
        while group := self._next():
            self._answer(group)
            del group  # while nothing waits, nothing is kept alive

    def _next(self) -> list[_Waiting]:
        """What is computed next: the oldest and what can share its batch. Empty at the end."""
        with self._changed:
            while True:
                # A client that is gone has cancelled.
                while self._waiting and not self._waiting[0].future.set_running_or_notify_cancel():
                    self._waiting.popleft()
                if self._waiting:
                    break
                if self._closing:
                    return []
                self._changed.wait()
            group, rest = [self._waiting.popleft()], deque[_Waiting]()
            wanted = group[0].job.group
            for waiting in self._waiting:
                fits = len(group) < self._sizes[-1] and waiting.job.group == wanted
                if not fits:
                    rest.append(waiting)
                elif waiting.future.set_running_or_notify_cancel():
                    group.append(waiting)
            self._waiting = rest
            return group

    def _answer(self, group: list[_Waiting]) -> None:
        start = time.perf_counter()
        size = next(size for size in self._sizes if size >= len(group))
        try:
            answers = self._engine.run([waiting.job for waiting in group], size)
        except Exception as error:  # handed to the one who waits for it: this thread serves the others
            if len(group) > 1:
                logger.info("A batch of %d failed and is computed one by one: %s", len(group), error)
                for waiting in group:
                    self._answer([waiting])
                return
            self._fail(group[0], error)
            return
        self._failures = 0
        for waiting, answer in zip(group, answers, strict=True):
            waiting.future.set_result(answer._replace(queue_ms=(start - waiting.since) * 1e3))

    def _fail(self, waiting: _Waiting, error: Exception) -> None:
        if isinstance(error, ValueError):  # the policy's own sentence about an observation
            told = error if isinstance(error, RequestError) else RequestError(shown(str(error).partition("\n")[0], 500))
            waiting.future.set_exception(told)
            return
        waiting.future.set_exception(error)
        self._failures += 1
        if self._failures >= _UNHEALTHY_AFTER and self._warms_up():
            self._failures = 0  # the policy is well: it was the requests after all

    def _warms_up(self) -> bool:
        try:
            self._warm_up()
        except Exception as error:  # any: the question is whether it can
            logger.error("The policy fails on its own warm-up too: %s", error)
            return False
        return True
