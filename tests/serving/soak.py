"""Robots and a server for minutes, with faults: `python -m tests.serving.soak --minutes 30`.

Several robots (processes) ask one server (a process), each with observations that only it sends, at its control rate. From time
to time something goes wrong: a robot is killed, a stranger sends half a frame, a stranger is silent, or the server is
killed and started again. The server's chunk is a function of the observation and of the noise, which robots know, so a lost, late
or foreign chunk is noticed.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import random
import socket
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_pi05_geometry.serving.client import PolicyClient, RefusedError, ServerLostError
from lerobot_policy_pi05_geometry.serving.engine import Answer, Job
from lerobot_policy_pi05_geometry.serving.inputs import Inputs
from lerobot_policy_pi05_geometry.serving.limits import Limits
from lerobot_policy_pi05_geometry.serving.noise import request_noise
from lerobot_policy_pi05_geometry.serving.websocket_server import WebsocketServer
from lerobot_policy_pi05_geometry.serving.worker import BatchWorker
from tests.entry_points import ACTION_DIM, CHUNK, STATE_DIM, make_calibration, make_config
from tests.serving.processes import POSE

SEED, SHAPE = 4, (CHUNK, 8)
FAULTS = ("kill a robot", "half a frame", "silence", "restart the server")


def make_request(side: int, value: float) -> dict[str, Any]:
    """Two RGB-D cameras; the state is what the chunk is made of."""
    height, width = size_of(side)
    image, depth = np.full((height, width, 3), 127, np.uint8), np.full((height, width), 1000, np.uint16)
    return {
        "images": {"front": image, "wrist": image}, "depth": {"front": depth, "wrist": depth},
        "state": np.full(STATE_DIM, value, np.float32), "prompt": "push",
    }  # fmt: skip


def robot(number: int, port: int, side: int, rate: float, results: Any) -> None:
    """One robot, until it is killed. Reports (robot, milliseconds, wrong, lost connections) of every chunk."""
    client, step, lost = None, 0, 0
    while True:
        try:
            if client is None:
                client = PolicyClient(f"ws://127.0.0.1:{port}", timeout=5.0)
            value = float(np.float32(number + step / 1e4))
            begin = time.perf_counter()
            answer = client.infer(make_request(side, value))
            spent = (time.perf_counter() - begin) * 1e3
            noise = request_noise(SEED, answer["session"], answer["request"], SHAPE).numpy()
            wrong = not np.array_equal(answer["actions"], noise[:, :ACTION_DIM] + np.float32(value))
            timing = answer["server_timing"]
            results.send((number, spent, bool(wrong), lost, timing["queue_ms"] + timing["infer_ms"]))
            lost, step = 0, step + 1
            time.sleep(max(0.0, 1 / rate - (time.perf_counter() - begin)))
        except (ServerLostError, RefusedError):
            if client is not None:
                client.close()
            client, lost = None, lost + 1
            time.sleep(0.2)


class EchoEngine:
    """A chunk is noise plus the state of its own observation, after 10 ms."""

    def run(self, jobs: Sequence[Job], size: int) -> list[Answer]:
        time.sleep(0.01)
        answers = []
        for job in jobs:
            actions = job.noise.numpy()[:, :ACTION_DIM] + job.request.observation["observation.state"][:ACTION_DIM]
            answers.append(Answer(actions, torch.from_numpy(actions.copy()), 10.0, len(jobs)))
        return answers


def serve(port: int, side: int, log: Path) -> None:
    """The server's process."""
    with log.open("a") as output:
        os.dup2(output.fileno(), sys.stdout.fileno())
        os.dup2(output.fileno(), sys.stderr.fileno())
    height, width = size_of(side)
    cameras = {f"observation.images.{name}": (3, height, width) for name in ("front", "wrist")}
    depth = {f"{key}_depth": (1, height, width) for key in cameras}
    visual = {key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in (cameras | depth).items()}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (STATE_DIM,))}
    calibration = make_calibration()
    calibration["wrist"].extrinsics = POSE
    config = make_config(input_features=visual | state, calibration=calibration)
    config.validate_features()
    limits = Limits()
    worker = BatchWorker(EchoEngine(), (1, 2, 4), limits.queue)
    server = WebsocketServer(worker, Inputs(config, limits), limits, {"protocol": "soak"}, SEED, SHAPE)
    asyncio.run(server.run("127.0.0.1", port, asyncio.Event(), keepalive=5.0))


def size_of(side: int) -> tuple[int, int]:
    """Height and width."""
    return (480, 640) if side == 640 else (30, 40)


class Server:
    """A server process, on the same port whenever it starts."""

    def __init__(self, context: Any, side: int, log: Path) -> None:
        self._context, self._side, self.log = context, side, log
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.start()

    def start(self) -> None:
        self.process = self._context.Process(target=serve, args=(self.port, self._side, self.log), daemon=True)
        self.process.start()
        end = time.monotonic() + 60
        while True:
            try:
                PolicyClient(f"ws://127.0.0.1:{self.port}", timeout=2.0).close()
                return
            except ServerLostError:
                assert self.process.is_alive(), self.log.read_text()
                assert time.monotonic() < end, self.log.read_text()
                time.sleep(0.05)

    def memory(self) -> float:
        """Resident MiB."""
        return float(psutil.Process(self.process.pid).memory_info().rss / 2**20)

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


def half_a_frame(port: int) -> socket.socket:
    """A stranger who begins a frame of 1 MiB."""
    stranger = silent(port)
    stranger.sendall(b"\x82\xff" + (2**20).to_bytes(8, "big") + b"\0\0\0\0" + b"x" * 1000)
    return stranger


def silent(port: int) -> socket.socket:
    """A stranger who connects, and says nothing more."""
    stranger = socket.create_connection(("127.0.0.1", port))
    stranger.sendall(
        b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    return stranger


def soak(seconds: float, robots: int, fault: float, rate: float, side: int) -> dict[str, Any]:
    """Run it, and say what was seen."""
    # Forked, since to import everything anew takes a robot ten seconds.
    context, chance = multiprocessing.get_context("fork"), random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        server = Server(context, side, Path(folder) / "server.log")
        port = server.port
        running = {i: start_robot(context, i, port, side, rate) for i in range(robots)}
        strangers, latencies, overheads, wrong, lost = [], [], [], 0, 0
        counts, done = dict.fromkeys(range(robots), 0), dict.fromkeys(FAULTS, 0)
        memory: list[list[float]] = [[]]
        begin = time.monotonic()
        next_fault, next_memory, kinds = begin + fault, begin + 2, []
        try:
            while time.monotonic() - begin < seconds:
                for number, spent, bad, broken, inside in arrived(running):
                    latencies.append(spent)
                    overheads.append(spent - inside)
                    counts[number] += 1
                    wrong, lost = wrong + bad, lost + broken
                if time.monotonic() >= next_memory:
                    memory[-1].append(server.memory())
                    next_memory += 2
                if time.monotonic() >= next_fault:
                    next_fault += fault
                    kinds = kinds or chance.sample(FAULTS, len(FAULTS))
                    kind = kinds.pop()
                    done[kind] += 1
                    if kind == "kill a robot":
                        victim = chance.randrange(robots)
                        running[victim][0].kill()
                        running[victim][0].join()
                        running[victim] = start_robot(context, victim, port, side, rate)
                    elif kind == "restart the server":
                        server.kill()
                        memory.append([])
                        server.start()
                    else:
                        strangers.append((half_a_frame if kind == "half a frame" else silent)(server.port))
                time.sleep(0.01)
            log = server.log.read_text()
        finally:
            for process, _ in running.values():
                process.kill()
            server.kill()
            for stranger in strangers:
                stranger.close()
    ranked = sorted(latencies)
    overheads.sort()
    return {
        "seconds": seconds, "robots": robots, "chunks": len(latencies), "chunks_per_robot": list(counts.values()),
        "wrong_chunks": wrong, "lost_connections": lost, "faults": done,
        "p50_ms": statistics.median(ranked), "p95_ms": ranked[int(0.95 * len(ranked))],
        "overhead_p50_ms": statistics.median(overheads), "overhead_p95_ms": overheads[int(0.95 * len(overheads))],
        # Of every life of the server: after a third of it, when robots are back, and at its end.
        "memory_mib": [[round(part[len(part) // 3], 1), round(part[-1], 1)] for part in memory if part],
        "tracebacks": log.count("Traceback"),
    }  # fmt: skip


def start_robot(context: Any, number: int, port: int, side: int, rate: float) -> tuple[Any, Any]:
    """Its process, and what it reports through: a pipe of its own, since one that is killed may have written half."""
    reader, writer = context.Pipe(duplex=False)
    process = context.Process(target=robot, args=(number, port, side, rate, writer), daemon=True)
    process.start()
    writer.close()
    return process, reader


def arrived(running: dict[int, tuple[Any, Any]]) -> list[tuple]:
    """What robots have reported."""
    found = []
    for _, reader in running.values():
        while reader.poll():
            found.append(reader.recv())
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--fault", type=float, default=30, help="seconds between faults")
    parser.add_argument("--rate", type=float, default=3, help="chunks a second and robot")
    parser.add_argument("--side", type=int, default=640, choices=(40, 640), help="width of the images")
    given = parser.parse_args()
    result = soak(60 * given.minutes, given.robots, given.fault, given.rate, given.side)
    print(json.dumps(result, indent=2))  # noqa: T201


if __name__ == "__main__":
    main()
