"""The queue and the thread: who shares a batch, who hears of an error, what happens when it is full or ends."""

import threading
import time

import numpy as np
import pytest

from lerobot_policy_pi05_geometry.serving.engine import make_job
from lerobot_policy_pi05_geometry.serving.limits import BusyError, Limits, RequestError
from lerobot_policy_pi05_geometry.serving.session import Session
from lerobot_policy_pi05_geometry.serving.worker import BatchWorker

from .running import CHUNK, FakeEngine, fake_service, make_request

STATES = np.eye(7, dtype=np.float32)


def job(service, i: int = 0, task: str = "go", **more):
    request = service.inputs.read(make_request(task=task) | {"state": STATES[i]} | more)
    return make_job(Session(), request, 0, (CHUNK, 8))


@pytest.fixture
def engine():
    return FakeEngine()


@pytest.fixture
def service(engine):
    service = fake_service(engine, limits=Limits(queue=8))
    service.worker.start()
    service.worker.wait_until_warm()
    yield service
    engine.release.set()
    service.worker.close()


def held(engine, service):
    """Begin a request that holds the thread up until `engine.release`; returns its future."""
    engine.release.clear()
    future = service.worker.submit(job(service, 6))
    while not engine.batches:
        time.sleep(0.001)
    return future


def test_what_waits_is_served_together_and_everyone_gets_his_own(engine, service):
    first = held(engine, service)
    futures = [service.worker.submit(job(service, i)) for i in range(3)]
    engine.release.set()
    for i, future in enumerate(futures):
        answer = future.result(5)
        assert answer.actions[0].tolist() == STATES[i][:5].tolist()
        assert answer.queue_ms > 0
    assert first.result(5).actions[0].tolist() == STATES[6][:5].tolist()
    assert [len(batch) for batch in engine.batches] == [1, 3]
    assert engine.sizes == [1, 4]  # 3 are filled up to the next size


def test_a_batch_is_not_larger_than_the_largest_size(engine, service):
    held(engine, service)
    futures = [service.worker.submit(job(service, i % 7)) for i in range(6)]
    engine.release.set()
    [future.result(5) for future in futures]
    assert [len(batch) for batch in engine.batches] == [1, 4, 2]


def test_other_shapes_make_another_batch_and_the_oldest_goes_first(engine, service):
    held(engine, service)
    small = {"images": make_request()["images"] | {"front": np.zeros((20, 20, 3), np.uint8)}}
    futures = [service.worker.submit(job(service, i, **(small if i % 2 else {}))) for i in range(4)]
    engine.release.set()
    for i, future in enumerate(futures):
        assert future.result(5).actions[0].tolist() == STATES[i][:5].tolist()
    assert [len(batch) for batch in engine.batches] == [1, 2, 2]
    assert engine.batches[1][0].request.observation["observation.state"].tolist() == STATES[0].tolist()


@pytest.mark.parametrize(("task", "kind", "sentence"), [
    ("bad", RequestError, "^This observation is bad.$"),
    ("broken", RuntimeError, "out of memory"),
])  # fmt: skip
def test_one_bad_row_is_its_own_clients_error(engine, service, task, kind, sentence):
    held(engine, service)
    futures = [service.worker.submit(job(service, i, task if i == 1 else "go")) for i in range(3)]
    engine.release.set()
    assert futures[0].result(5).actions[0].tolist() == STATES[0][:5].tolist()
    assert futures[2].result(5).actions[0].tolist() == STATES[2][:5].tolist()
    with pytest.raises(kind, match=sentence):
        futures[1].result(5)
    assert [len(batch) for batch in engine.batches] == [1, 3, 1, 1, 1]


def test_who_has_gone_is_not_computed_for(engine, service):
    held(engine, service)
    gone, stays = service.worker.submit(job(service, 0)), service.worker.submit(job(service, 1))
    assert gone.cancel()
    engine.release.set()
    stays.result(5)
    assert [len(batch) for batch in engine.batches] == [1, 1]


def test_the_queue_is_bounded(engine, service):
    held(engine, service)
    futures = [service.worker.submit(job(service)) for _ in range(8)]
    with pytest.raises(BusyError, match="busy: 8 requests are waiting"):
        service.worker.submit(job(service))
    engine.release.set()
    [future.result(5) for future in futures]


def test_closing_finishes_what_waits_and_takes_no_more(engine, service):
    held(engine, service)
    futures = [service.worker.submit(job(service, i)) for i in range(3)]
    closing = threading.Thread(target=service.worker.close)
    closing.start()
    time.sleep(0.05)
    with pytest.raises(BusyError, match="shutting down"):
        service.worker.submit(job(service))
    engine.release.set()
    closing.join(5)
    assert all(future.done() for future in futures)
    assert not service.worker.healthy


def test_it_is_unhealthy_after_failures_that_no_request_is_to_blame_for(engine, service):
    def broken():
        raise RuntimeError("the device is gone")

    service.worker._warm_up = broken

    def fail(task):
        with pytest.raises((RuntimeError, RequestError)):
            service.worker.submit(job(service, task=task)).result(5)

    for _ in range(5):
        fail("bad")
    fail("broken")
    fail("broken")
    assert service.worker.healthy
    service.worker.submit(job(service)).result(5)
    for _ in range(3):
        assert service.worker.healthy
        fail("broken")
    while service.worker.healthy:  # it is asked to warm up after the answer
        time.sleep(0.01)
    service.worker.submit(job(service)).result(5)
    assert service.worker.healthy


def test_one_client_cannot_make_it_unhealthy(service):
    """Requests that fail are theirs as long as the policy's own one does not."""
    for _ in range(7):
        with pytest.raises(RuntimeError):
            service.worker.submit(job(service, task="broken")).result(5)
    end = time.monotonic() + 10
    while not service.worker.healthy:  # until it has warmed up after the last answer
        assert time.monotonic() < end
        time.sleep(0.01)


def test_nothing_is_answered_before_warming_up_and_what_it_raises_is_told(engine):
    warm = threading.Event()
    worker = BatchWorker(engine, (1,), 8, lambda: warm.wait(5))
    service = fake_service(engine)
    worker.start()
    future = worker.submit(job(service))
    time.sleep(0.05)
    assert not future.done()
    assert not worker.healthy
    warm.set()
    future.result(5)
    assert worker.healthy
    worker.close()

    def fail():
        raise ValueError("no kernel")

    worker = BatchWorker(engine, (1,), 8, fail)
    future = worker.submit(job(service))
    worker.start()
    with pytest.raises(ValueError, match="no kernel"):
        worker.wait_until_warm()
    with pytest.raises(BusyError, match="could not start"):
        future.result(5)


@pytest.mark.parametrize("sizes", [(), (0, 1), (2, 1), (1, 1)])
def test_sizes_that_are_none(engine, sizes):
    with pytest.raises(ValueError, match="ascending numbers from 1 on"):
        BatchWorker(engine, sizes, 8)
