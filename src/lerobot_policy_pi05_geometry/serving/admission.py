"""Who may connect: decided on the HTTP request, before there is a websocket."""

import hmac
import ipaddress
import os
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

KEY_VARIABLE = "PI05_GEOMETRY_API_KEY"
KEY_LENGTH = 16


class Admission:
    """Answers /healthz, and refuses browsers, wrong keys and more sessions than there is room for.

    key: what clients must send as `Authorization: Api-Key <key>`; None: no key is asked for. why_not: says why no session can
    begin now, None if one can. healthy: whether requests are answered.
    """

    def __init__(self, key: str | None, why_not: Callable[[], str | None], healthy: Callable[[], bool]) -> None:
        self._expected = None if key is None else f"Api-Key {key}".encode()
        self._why_not, self._healthy = why_not, healthy

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == "/healthz":
            why = self._why_not()
            if why is None and self._healthy():
                return connection.respond(HTTPStatus.OK, "OK\n")
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{why or 'not healthy'}\n")
        # A browser names the page that asks; a robot is none. Without this, any web page could reach a server on loopback.
        if request.headers.get_all("Origin"):
            return connection.respond(HTTPStatus.FORBIDDEN, "Browsers are not served.\n")
        if self._expected is not None:
            given = request.headers.get_all("Authorization")
            if len(given) != 1 or not hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), self._expected):
                return connection.respond(HTTPStatus.UNAUTHORIZED, "The key is missing or wrong.\n")
        why = self._why_not()
        if why is not None:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{why}\n")
        return None


def read_key(path: Path | None) -> str | None:
    """The key in a file, or in the environment variable PI05_GEOMETRY_API_KEY; None if neither is there.

    Not an option of the command: every user of a machine sees the commands that run. Raises ValueError for one that is too short.
    """
    if path is not None and not path.is_file():
        raise FileNotFoundError(
            f"Key file {path} is not there; write a key of at least {KEY_LENGTH} characters into it."
        )
    given = os.environ.get(KEY_VARIABLE) if path is None else path.read_text()
    if not given:
        return None
    key = given.strip()
    if len(key) < KEY_LENGTH or not key.isascii() or not key.isprintable():
        raise ValueError(
            f"The key must be at least {KEY_LENGTH} printable ASCII characters; `openssl rand -hex 32` makes a good one."
        )
    return key


def require_safe(host: str, key: str | None) -> None:
    """Raise ValueError for a host that others can reach, unless there is a key."""
    if key is None and not is_loopback(host):
        raise ValueError(
            f"--host {host} can be reached from other machines, so clients need a key: put one of at least {KEY_LENGTH} "
            f"characters into a file and give it as --key-file, or set {KEY_VARIABLE}."
        )


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host. Names other than localhost count as reachable."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
