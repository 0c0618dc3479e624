"""The key that clients must know, and which addresses need one."""

import ipaddress
import os
from pathlib import Path

KEY_VARIABLE = "PI05_GEOMETRY_API_KEY"
KEY_LENGTH = 16


def read_key(path: Path | None) -> str | None:
    """The key in a file, or in the environment variable PI05_GEOMETRY_API_KEY; None if neither is there.

    Not an option of the command: every user of a machine sees the commands that run. Raises ValueError for one that is too short;
    an empty one too, since a secret that was not mounted must not open the server to everyone.
    """
    if path is not None and not path.is_file():
        raise FileNotFoundError(
            f"Key file {path} is not there; write a key of at least {KEY_LENGTH} characters into it."
        )
    given = os.environ.get(KEY_VARIABLE) if path is None else path.read_text()
    if given is None:
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
