"""What the server keeps of one robot: which request comes next, which cameras it has, and its last chunk."""

import secrets
from dataclasses import dataclass, field

from torch import Tensor


def new_name() -> str:
    """A session's name: unique, and not to be guessed from others."""
    return secrets.token_hex(8)


@dataclass
class Session:
    """One robot's connection. requests: answered so far, over all its episodes; with the name, the key of the noise."""

    name: str = field(default_factory=new_name)
    requests: int = 0
    episode: int = 0
    begins: bool = True  # whether the next request is the first of an episode
    seen: set[str] = field(default_factory=set)  # keys of geometry that it has sent
    chunk: Tensor | None = None  # the last, normalised: (S, A) on the CPU
    rig: int | None = None  # which one the robot is, of a policy that knows several

    def reset(self) -> None:
        """A new episode: the next chunk continues none."""
        self.episode += 1
        self.begins, self.chunk = True, None
