"""What real-time chunking hands over of the previous chunk."""

from typing import Any

from torch import Tensor


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
