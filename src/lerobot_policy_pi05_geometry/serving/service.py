"""A checkpoint, ready to be served by either protocol."""

import asyncio
import signal
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from lerobot.processor import RenameObservationsProcessorStep

from ..checkpoint.load import LoadedPolicy, load_policy
from .engine import PolicyEngine
from .inputs import Inputs
from .keys import read_key, require_safe
from .limits import Limits
from .metadata import describe
from .renaming import without_renaming
from .websocket_server import WebsocketServer
from .worker import BatchWorker

_DISTRIBUTION = "lerobot_policy_pi05_geometry"


class Service(NamedTuple):
    """What the servers share. The worker has not been started."""

    engine: PolicyEngine
    inputs: Inputs
    worker: BatchWorker
    limits: Limits


def make_service(
    loaded: LoadedPolicy, sizes: Sequence[int] | None = None, limits: Limits | None = None, rig: int | None = None
) -> Service:
    """sizes: of batches, ascending; None: up to 4, in steps for which a GPU's graphs are recorded. rig: the only one served.

    Raises ValueError for a rig that the checkpoint does not have.
    """
    limits = limits or Limits()
    engine = PolicyEngine(without_renaming(loaded))
    steps = getattr(loaded.preprocess, "steps", ())
    rename = next((s.rename_map for s in steps if isinstance(s, RenameObservationsProcessorStep)), None)
    inputs = Inputs(engine.config, limits, rename, rig)
    if sizes is None:
        sizes = (1, 2, 4) if str(engine.config.device).startswith("cuda") else (1, 2, 3, 4)
    worker = BatchWorker(engine, sizes, limits.queue, lambda: engine.warm(inputs, sizes))
    return Service(engine, inputs, worker, limits)


def make_websocket_server(service: Service, seed: int = 0, key: str | None = None) -> WebsocketServer:
    """seed: of the noise. key: what clients must know; None on loopback only."""
    engine, inputs, worker, limits = service
    metadata = describe(engine, inputs, seed, version(_DISTRIBUTION))
    return WebsocketServer(worker, inputs, limits, metadata, seed, engine.noise_shape, key)


def serve_websocket(
    checkpoint: str,
    device: str,
    host: str,
    port: int,
    key_file: Path | None,
    sizes: Sequence[int] | None,
    seed: int,
    listening: Callable[[int], None],
    rig: int | None = None,
) -> None:
    """Serve a checkpoint until SIGTERM or SIGINT. Raises ValueError for a host that others reach without a key."""
    key = read_key(key_file)
    require_safe(host, key)
    server = make_websocket_server(make_service(load_policy(checkpoint, device), sizes, rig=rig), seed, key)

    async def run() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        await server.run(host, port, stop, listening)

    asyncio.run(run())
