"""Flow matching: the noise, the flow time and the dropout draw of a training sample.

Convention (openpi): flow time 1 is noise, 0 is the clean action; x_t = t * noise + (1 - t) * action and the network
predicts the velocity noise - action.

LeRobot draws the data order from torch's global generator, so a resumed run would draw other noise than one that never
stopped. Here every draw is a function of (seed, step, dataset index) alone, through numpy's counter-based Philox
generator: a resumed run, or another number of processes, draws the same.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

_MASK = (1 << 64) - 1


class FlowDraw(NamedTuple):
    """The random numbers of a training batch, on the CPU."""

    noise: Tensor  # (B, S, D) float32, standard normal; (B, K, S, D) for K > 1 flow samples
    time: Tensor  # (B,) float32 in (0, 1]; (B, K)
    dropout: Tensor  # (B,) float32, uniform in [0, 1): which inputs are masked (training/dropout.py)
    camera: Tensor  # (B,) float32, uniform in [0, 1): which camera, if one camera is masked
    delay: Tensor  # (B,) int64 in [0, max_delay]: action steps of the hard prefix (real_time_chunking.py)
    key: Tensor  # (B,) int64 of 62 bits: of what is drawn on the device (geometry/depth_augmentation.py)


def draw_flow(
    seed: int,
    step: int,
    indices: list[int],
    shape: tuple[int, int],
    *,
    alpha: float,
    beta: float,
    scale: float,
    offset: float,
    samples: int = 1,
    max_delay: int = 0,
) -> FlowDraw:
    """Draw noise, flow time Beta(alpha, beta) * scale + offset, two uniform numbers, a delay and a key for each dataset index.

    seed: of the run. step: optimiser steps done so far. indices: dataset index of each of the B samples.
    shape: (S, D) of one action chunk. samples: K, noises and times per observation. max_delay: of the hard prefix.
    Returns a `FlowDraw`.
    """
    noise: list[np.ndarray] = []
    time: list[np.ndarray] = []
    dropout, camera, delay, key = [], [], [], []
    for index in indices:
        generator = np.random.Generator(
            np.random.Philox(
                key=np.array([seed & _MASK, index & _MASK], dtype=np.uint64),
                counter=np.array([0, 0, 0, step & _MASK], dtype=np.uint64),
            )
        )
        noise.append(generator.standard_normal((samples, *shape), dtype=np.float32))
        time.append(generator.beta(alpha, beta, samples) * scale + offset)
        dropout.append(generator.random())
        camera.append(generator.random())
        key.append(generator.integers(0, 1 << 62))
        delay.append(generator.integers(0, max_delay, endpoint=True))  # last: with 0 nothing is drawn
    noises, times = torch.from_numpy(np.stack(noise)), torch.from_numpy(np.stack(time)).float()
    if samples == 1:
        noises, times = noises[:, 0], times[:, 0]
    return FlowDraw(
        noises,
        times,
        torch.tensor(dropout, dtype=torch.float32),
        torch.tensor(camera, dtype=torch.float32),
        torch.tensor(delay),
        torch.tensor(key),
    )
