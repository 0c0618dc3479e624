"""A server in this process, and requests as clients send them."""

import asyncio
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy
from lerobot_policy_pi05_geometry.geometry.calibration import Rig
from lerobot_policy_pi05_geometry.serving.engine import Answer, Job
from lerobot_policy_pi05_geometry.serving.inputs import Inputs
from lerobot_policy_pi05_geometry.serving.limits import Limits
from lerobot_policy_pi05_geometry.serving.service import Service, make_service, make_websocket_server
from lerobot_policy_pi05_geometry.serving.websocket_server import WebsocketServer
from lerobot_policy_pi05_geometry.serving.worker import BatchWorker
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    FRONT_DEPTH,
    STATE,
    WRIST,
    WRIST_DEPTH,
    WRIST_POSE,
    make_calibration,
    make_config,
    make_observation,
    make_policy,
    make_processors,
)

from .processes import POSE


def load(seed: int = 0, **changes: Any) -> LoadedPolicy:
    """A tiny policy with its processors."""
    policy = make_policy(seed, **changes)
    return LoadedPolicy(policy, *make_processors(policy.config))


def make_rigs(second_pose: list[list[float]] | None) -> dict[str, Rig]:
    """Two robots whose cameras differ. second_pose: of the second one's wrist camera; None: it comes with every request."""
    first, second = make_calibration(), make_calibration()
    first["wrist"].extrinsics, second["wrist"].extrinsics = POSE, second_pose
    second["front"] = replace(second["front"], intrinsics=[60.0, 20.0, 10.0, 20.0], extrinsics=POSE)
    return {"2": Rig(first), "5": Rig(second)}


def make_request(seed: int = 0, task: str = "push the button") -> dict[str, Any]:
    """A request in openpi's nested spelling, with two RGB-D cameras; what a robot would send."""
    observation = make_observation(1, seed)
    return {
        "images": {"front": pixels(observation[FRONT]), "wrist": pixels(observation[WRIST])},
        "depth": {
            "front": observation[FRONT_DEPTH][0, 0].numpy(),
            "wrist": observation[WRIST_DEPTH][0, 0].numpy().astype(np.uint16),
        },
        "extrinsics": {"wrist": observation[WRIST_POSE][0].numpy()},
        "state": observation[STATE][0].numpy(),
        "prompt": task,
    }


def pixels(images: torch.Tensor) -> np.ndarray:
    """(1, 3, H, W) in [0, 1] -> (H, W, 3) uint8."""
    return (images[0] * 255).byte().permute(1, 2, 0).contiguous().numpy()


def observation_of(*requests: dict[str, Any]) -> dict[str, Any]:
    """The raw batch that a local run of the same robots would give the preprocessor."""

    def stack(*path: str) -> torch.Tensor:
        found = []
        for request in requests:
            value = request
            for name in path:
                value = value[name]
            found.append(torch.from_numpy(np.array(value)))
        return torch.stack(found)

    def images(camera: str) -> torch.Tensor:
        return (stack("images", camera).float() / 255).permute(0, 3, 1, 2).contiguous()

    return {
        FRONT: images("front"),
        WRIST: images("wrist"),
        FRONT_DEPTH: stack("depth", "front")[:, None],
        WRIST_DEPTH: stack("depth", "wrist")[:, None],
        WRIST_POSE: stack("extrinsics", "wrist"),
        STATE: stack("state"),
        "task": [request["prompt"] for request in requests],
    }


def local_chunk(loaded: LoadedPolicy, requests: Sequence[dict[str, Any]], noise: torch.Tensor, **how: Any):
    """Normalised chunk and actions (B, S, A) of a local run."""
    loaded.policy.reset()
    with torch.no_grad():
        batch = loaded.preprocess(observation_of(*requests))
        chunk = loaded.policy.predict_action_chunk(batch, noise=noise, **how)
        return chunk, loaded.postprocess(chunk)


class Running:
    """A server that runs in a thread."""

    def __init__(self, server: WebsocketServer, **settings: Any) -> None:
        self.server = server
        self._settings = settings
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._listening = threading.Event()
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(
                self.server.run("127.0.0.1", 0, self._stop, self._note_port, **self._settings)
            )
        except BaseException as error:
            self.error = error
            self._listening.set()
        finally:
            self._loop.close()

    def _note_port(self, port: int) -> None:
        self.port = port
        self._listening.set()

    def start(self) -> "Running":
        self._thread.start()
        assert self._listening.wait(30)
        return self

    def terminate(self) -> None:
        """As SIGTERM does."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._stop.set)

    def join(self) -> None:
        self._thread.join(60)
        assert not self._thread.is_alive()
        assert not asyncio.all_tasks(self._loop)  # nothing of it is left behind

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"


@contextmanager
def serving(server: WebsocketServer, **settings: Any) -> Iterator[Running]:
    running = Running(server, **settings).start()
    try:
        yield running
    finally:
        running.terminate()
        running.join()


class FakeEngine:
    """An engine without a network: the chunk says which request it is of. delay: seconds for a batch."""

    def __init__(self, delay: float = 0.0) -> None:
        self.delay = delay
        self.batches: list[list[Job]] = []
        self.sizes: list[int] = []
        self.release = threading.Event()
        self.release.set()

    def run(self, jobs: Sequence[Job], size: int) -> list[Answer]:
        self.batches.append(list(jobs))
        self.sizes.append(size)
        assert self.release.wait(60)
        time.sleep(self.delay)
        for job in jobs:
            if job.request.task == "bad":
                raise ValueError("This observation is bad.\nAnd this line is for the log.")
            if job.request.task == "broken":
                raise RuntimeError("/secret/path: out of memory")
        return [answer_to(job, len(jobs)) for job in jobs]


def answer_to(job: Job, batch: int = 1) -> Answer:
    """A chunk that is made of the state, so that a foreign one is noticed."""
    actions = np.tile(job.request.observation[STATE][:ACTION_DIM], (CHUNK, 1))
    return Answer(actions, torch.from_numpy(actions.copy()), 1.0, batch)


def fake_service(engine: FakeEngine, sizes: Sequence[int] = (1, 2, 4), limits: Limits | None = None) -> Service:
    limits = limits or Limits()
    config = make_config()
    config.validate_features()
    worker = BatchWorker(engine, sizes, limits.queue)
    return Service(engine, Inputs(config, limits), worker, limits)  # type: ignore[arg-type]


def fake_server(
    engine: FakeEngine, key: str | None = None, limits: Limits | None = None, **how: Any
) -> WebsocketServer:
    service = fake_service(engine, limits=limits, **how)
    return WebsocketServer(service.worker, service.inputs, service.limits, {"protocol": "test"}, 0, (CHUNK, 8), key)


def real_server(loaded: LoadedPolicy, sizes: Sequence[int] = (1, 2, 4), seed: int = 0) -> WebsocketServer:
    return make_websocket_server(make_service(loaded, sizes), seed)
