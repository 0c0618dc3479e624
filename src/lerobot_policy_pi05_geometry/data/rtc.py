"""What real-time chunking hands over of the previous chunk."""

import logging
from typing import Any

from torch import Tensor

logger = logging.getLogger(__name__)


def without_padding(left_over: Tensor, delay: int | None) -> dict[str, Any]:
    """Arguments without trailing rows of zeros: `prev_chunk_left_over`, None if none is left, and an `inference_delay` of no more
    steps. {} if there are no such rows.

    left_over: (T, A) or (B, T, A). LeRobot fills what is missing up to the execution horizon with zeros. As a prefix they
    would pull
    the arm to the middle of its range.
    """
    rows = left_over if left_over.ndim == 2 else left_over.transpose(0, 1).flatten(1)  # (T, ...)
    real = rows.ne(0).any(dim=1).nonzero().flatten()
    steps = int(real[-1]) + 1 if len(real) else 0
    if steps == len(rows):
        return {}
    kept = left_over[..., :steps, :] if steps else None
    return {"prev_chunk_left_over": kept, "inference_delay": None if delay is None else min(delay, steps)}


class HardPrefixLength:
    """How many steps of the previous chunk trained real-time chunking is given. longest: that training knew.

    LeRobot gives the longest delay that it has ever met, so one late chunk must not end real-time chunking.
    """

    def __init__(self, longest: int) -> None:
        self._longest, self._told = longest, False

    def __call__(self, delay: int | None, left: int) -> int | None:
        """The delay, or fewer steps if training knew only shorter prefixes or fewer steps are left. Warns once."""
        most = min(self._longest, left)
        if delay is None or delay <= most:
            return delay
        if not self._told:
            logger.warning(
                "inference_delay is %d, but only %d steps can be given to this chunk (rtc_training_max_delay=%d, %d steps left "
                "over); those are. Where chunks are late again and again, act at a lower rate or use rtc_mode=guided.",
                delay, most, self._longest, left,
            )  # fmt: skip
        self._told = True
        return most
