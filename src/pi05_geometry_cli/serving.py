"""The command that serves a checkpoint to robots."""

from pathlib import Path
from typing import Annotated

import typer

from .app import app, console


@app.command()
def serve(
    checkpoint: Annotated[str, typer.Argument(help="Checkpoint folder (pretrained_model) or hub id.")],
    device: Annotated[str, typer.Option(help="Where the policy runs.")] = "cpu",
    host: Annotated[str, typer.Option(help="Address to listen at; one that others reach needs a key.")] = "127.0.0.1",
    port: Annotated[int | None, typer.Option(help="Default: 8000, with --lerobot 8080. 0 chooses a free one.")] = None,
    key_file: Annotated[
        Path | None, typer.Option(help="File with the key that clients must send. Default: $PI05_GEOMETRY_API_KEY.")
    ] = None,
    batch_sizes: Annotated[
        str | None, typer.Option(help="Sizes of batches, as 1,2,4: as many requests are computed together.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the noise, with the session and the request.")] = 0,
    rig: Annotated[
        int | None, typer.Option(help="Of a checkpoint trained on several rigs: the one whose robots are served.")
    ] = None,
    lerobot: Annotated[
        bool, typer.Option("--lerobot", help="LeRobot's robot_client instead of openpi's clients (gRPC, loopback).")
    ] = False,
    fps: Annotated[float | None, typer.Option(help="With --lerobot: the robot's control rate; 30 by default.")] = None,
) -> None:
    """Serve a checkpoint to robots on other machines: openpi's websocket protocol, or LeRobot's gRPC protocol."""
    from lerobot_policy_pi05_geometry.serving.extras import require_extra

    require_extra("serve", "websockets", "msgpack")
    sizes = None if batch_sizes is None else _sizes(batch_sizes)
    if lerobot:
        require_extra("serve-lerobot", "grpc")
        if key_file is not None:
            raise ValueError("LeRobot's robot_client can send no key, so --key-file has no use with --lerobot.")
        from lerobot_policy_pi05_geometry.serving.lerobot_wire.grpc_server import serve_lerobot

        console.print(f"Loading {checkpoint} ...")
        serve_lerobot(
            checkpoint, device, host, 8080 if port is None else port, sizes, seed, 30.0 if fps is None else fps,
            lambda at: console.print(f"Serving LeRobot's robot_client at {host}:{at}", soft_wrap=True), rig,
        )  # fmt: skip
        return
    if fps is not None:
        raise ValueError("--fps is for --lerobot; openpi's clients space a chunk's actions themselves.")
    from lerobot_policy_pi05_geometry.serving.service import serve_websocket

    console.print(f"Loading {checkpoint} ...")
    serve_websocket(
        checkpoint, device, host, 8000 if port is None else port, key_file, sizes, seed,
        lambda at: console.print(f"Serving at ws://{host}:{at}", soft_wrap=True), rig,
    )  # fmt: skip


def _sizes(given: str) -> tuple[int, ...]:
    parts = given.split(",")
    if not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--batch-sizes must be ascending numbers, as 1,2,4; got {given}.")
    return tuple(int(part) for part in parts)
