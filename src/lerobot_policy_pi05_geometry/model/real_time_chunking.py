"""Real-time chunking (RTC): a new chunk continues the one that the robot executes while the new one is computed.

```
   previous chunk   a0 a1 a2 a3 a4 a5 a6 a7         the robot executes a3, a4 while the new chunk is computed: delay 2
   what is left              a3 a4 a5 a6 a7
   new chunk                 b0 b1 b2 b3 b4 b5 b6 b7
                             └ d ┘ the first `delay` steps are executed anyway, so they must agree with a3, a4
```

guided (Black et al. 2025, arXiv 2506.07339): at every denoising step the velocity is corrected towards what is left, with
    weights that fall from 1 to 0. Any π0.5 can do it. LeRobot's `RTCProcessor` is the reference. It evaluates the velocity before
    it starts to track x, so the gradient of its estimate of the clean chunk x - t v(x) is the identity, and the correction is the
    weighted error itself: no gradient goes through the network.
trained (Black et al. 2025, arXiv 2512.05964): the first `delay` steps are given as clean actions at flow time 0, the others are
    denoised at the flow time t. The network must have been trained on it (`rtc_training_max_delay`).

Shapes: B batch, S action steps of a chunk, D max_action_dim.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor


class Guidance(NamedTuple):
    """Inputs of guided RTC: what is left of the previous chunk (B, S, D) float32, and a weight per step (S, 1) in [0, 1]."""

    target: Tensor
    weights: Tensor

    def correct(self, velocity: Tensor, x_t: Tensor, time: float, max_weight: float) -> Tensor:
        """The guided velocity at x_t and flow time `time`, all (B, S, D)."""
        error = (self.target - (x_t - time * velocity)) * self.weights
        return velocity - guidance_weight(time, max_weight) * error


class HardPrefix(NamedTuple):
    """Inputs of trained RTC: clean actions (B, S, D) float32, and a mask (S,) bool of the steps where they hold."""

    actions: Tensor
    mask: Tensor

    def impose(self, x_t: Tensor) -> Tensor:
        """x_t (B, S, D) with the clean actions where they hold."""
        return torch.where(self.mask[:, None], self.actions, x_t)


def guidance_weight(time: float, max_weight: float) -> float:
    """Factor of the correction at a flow time in (0, 1], as LeRobot's `RTCProcessor.denoise_step` computes it."""
    done = 1.0 - time  # the paper's flow time, which goes from 0 to 1
    if done <= 0.0:
        return max_weight
    return min(time / done * (time**2 + done**2) / time**2, max_weight)


def left_over_actions(left_over: Tensor, noise: Tensor) -> Tensor:
    """What is left of the previous chunk, (T, A) or (B or 1, T, A), in the shape (B, S, D) of `noise`, zeros behind it.

    Raises ValueError for another shape, more steps than a chunk has, or more action dimensions.
    """
    given = left_over[None] if left_over.ndim == 2 else left_over
    batch, steps, width = noise.shape
    if given.ndim != 3 or given.shape[0] not in (1, batch) or given.shape[1] > steps or given.shape[2] > width:
        raise ValueError(
            f"prev_chunk_left_over must be (T, A) or (B, T, A) with B = {batch}, T <= {steps} and A <= {width}, "
            f"got {tuple(left_over.shape)}."
        )
    padded = F.pad(given.to(noise), (0, width - given.shape[2], 0, steps - given.shape[1]))
    return padded.expand(batch, -1, -1)


def make_guidance(
    processor: RTCProcessor, left_over: Tensor | None, delay: int | None, horizon: int | None, noise: Tensor
) -> Guidance:
    """Guidance from LeRobot's arguments; weights of 0 where nothing is left over, which change nothing.

    delay: steps that are executed while the chunk is computed. horizon: steps from which on nothing guides, None for the
    configured number. noise: (B, S, D). Raises ValueError without a delay.
    """
    if left_over is None:
        return Guidance(torch.zeros_like(noise), torch.zeros_like(noise[0, :, :1]))
    target = left_over_actions(left_over, noise)
    end = min(processor.rtc_config.execution_horizon if horizon is None else horizon, left_over.shape[-2])
    weights = processor.get_prefix_weights(require_delay(delay), end, noise.shape[1])  # (S,)
    return Guidance(target, weights[:, None].to(noise.device, non_blocking=True))


def make_hard_prefix(left_over: Tensor | None, delay: int | None, max_delay: int, noise: Tensor) -> HardPrefix:
    """The hard prefix from LeRobot's arguments; a mask that is False where nothing is left over.

    Raises ValueError for a delay that the network was not trained for, or that more than what is left.
    """
    steps = torch.arange(noise.shape[1], device=noise.device)
    if left_over is None:
        return HardPrefix(torch.zeros_like(noise), steps < 0)
    actions, delay = left_over_actions(left_over, noise), require_delay(delay)
    if delay > max_delay:
        raise ValueError(
            f"inference_delay is {delay}, but this policy was trained with rtc_training_max_delay={max_delay}; train with a "
            "larger one, act at a lower rate, or use rtc_mode=guided."
        )
    if delay > left_over.shape[-2]:
        raise ValueError(f"inference_delay is {delay}, but prev_chunk_left_over has only {left_over.shape[-2]} steps.")
    return HardPrefix(actions, steps < delay)


def require_delay(delay: int | None) -> int:
    """The delay. Raises ValueError if it is missing or negative."""
    if delay is None or delay < 0:
        raise ValueError(f"prev_chunk_left_over needs inference_delay, a number of action steps; got {delay}.")
    return int(delay)
