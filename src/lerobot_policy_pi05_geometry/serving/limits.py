"""What a request may cost, and the errors that a client is told of."""

from dataclasses import dataclass

MIB = 2**20
PROTOCOL = "openpi-websocket/1"  # what metadata of this server says


class RequestError(ValueError):
    """A request that cannot be answered; its message is one sentence for the client and holds nothing of the server."""


class BusyError(RequestError):
    """The server has no room for the request now."""


class FailedError(RequestError):
    """The server failed, and the request is not to blame; what happened is in the server's log."""


def shown(text: str, length: int = 80) -> str:
    """A text that may be a client's, as it may stand in an answer and in the log: short, and nothing in it ends a line."""
    text = text if len(text) <= length else text[: length - 3] + "..."
    return "".join(character if character.isprintable() else "?" for character in text)


@dataclass(frozen=True)
class Limits:
    """Bounds that hold before anything is allocated.

    A request with two RGB-D cameras of 640 x 480 pixels is 3 MiB, with float32 images 9 MiB.
    """

    frame_bytes: int = 32 * MIB
    values: int = 4096  # of a frame: maps, their keys, arrays, strings, numbers
    depth: int = 8  # nested maps and lists
    arrays: int = 64
    dimensions: int = 4  # of an array
    text: int = 4096  # bytes of a string
    image_sides: tuple[int, int] = (8, 4096)  # pixels
    image_ratio: int = 8  # of an image's longer side to its shorter one
    sessions: int = 64
    queue: int = 64  # requests that wait
