"""The noise of a request: a function of (seed, session, request), whatever else is in its batch.

So a chunk can be computed again, and a robot gets the same chunk whether it is served alone or with others.
"""

import hashlib

import numpy as np
import torch
from torch import Tensor


def request_noise(seed: int, session: str, request: int, shape: tuple[int, int]) -> Tensor:
    """Standard normal noise (S, D) float32 on the CPU, from numpy's counter-based Philox generator.

    seed: of the server. session: its name. request: number of the request within the session, from 0.
    """
    key = hashlib.sha256(f"{seed}/{session}".encode()).digest()[:16]
    generator = np.random.Generator(
        np.random.Philox(key=np.frombuffer(key, dtype=np.uint64), counter=np.array([0, 0, 0, request], dtype=np.uint64))
    )
    return torch.from_numpy(generator.standard_normal(shape, dtype=np.float32))
