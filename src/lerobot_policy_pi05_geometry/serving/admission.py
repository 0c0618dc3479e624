"""Who may connect: decided on the HTTP request, before there is a websocket."""

import hmac
from collections.abc import Callable
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response


class Admission:
    """Answers /healthz, and refuses browsers, wrong keys and more sessions than there is room for.

    key: what clients must send as `Authorization: Api-Key <key>`; None: no key is asked for. why_full: says why no session can
    begin now, why_ill: why requests are not answered; None if they can and are.
    """

    def __init__(self, key: str | None, why_full: Callable[[], str | None], why_ill: Callable[[], str | None]) -> None:
        self._expected = None if key is None else f"Api-Key {key}".encode()
        self._why_full, self._why_ill = why_full, why_ill

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == "/healthz":
            ill = self._why_ill()
            if ill is None:
                return connection.respond(HTTPStatus.OK, "OK\n")
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{ill}\n")
        # A browser names the page that asks; a robot is none. Without this, any web page could reach a server on loopback.
        if request.headers.get_all("Origin"):
            return connection.respond(HTTPStatus.FORBIDDEN, "Browsers are not served.\n")
        if self._expected is not None:
            given = request.headers.get_all("Authorization")
            if len(given) != 1 or not hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), self._expected):
                return connection.respond(HTTPStatus.UNAUTHORIZED, "The key is missing or wrong.\n")
        full = self._why_full()
        if full is not None:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{full}\n")
        return None
