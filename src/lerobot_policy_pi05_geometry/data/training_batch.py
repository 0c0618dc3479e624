"""What a training batch must have before it reaches a weight, and which of its steps count.

One NaN in one action would make every weight NaN in that step. The errors name the frame of the dataset.
"""

from collections.abc import Mapping
from typing import Any

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor


def check_actions(actions: Tensor, batch: Mapping[str, Any], width: int) -> None:
    """Check the actions (B, S, A) of a batch.

    Raises ValueError if A is not `width`, or if an action is NaN or inf, naming the sample's dataset index, the step and the
    dimension.
    """
    if actions.shape[-1] != width:
        raise ValueError(
            f"The batch has {actions.shape[-1]} action dimensions, but the policy has {width}; train on data of the robot that "
            "the policy is for, or start a policy with these dimensions."
        )
    finite = actions.isfinite()
    if not finite.all():
        row, step, dim = (~finite).nonzero()[0].tolist()
        raise ValueError(
            f"{ACTION}[{dim}] is {actions[row, step, dim].item()}, {step} frames after {sample_name(batch, row)}. Correct that "
            "frame or leave out its episode (`lerobot-edit-dataset`). If the dataset has no such value there, its statistics "
            "have."
        )


def valid_steps(actions: Tensor, is_pad: Tensor | None, padded_actions: str) -> Tensor:
    """Which steps of actions (B, S, A) count in the loss, (B, S) bool.

    is_pad: (B, S) bool, steps after the end of an episode. padded_actions: the configuration's setting.
    """
    if is_pad is None or padded_actions == "supervised":
        return torch.ones(actions.shape[:2], dtype=torch.bool, device=actions.device)
    return ~is_pad


def require_finite_losses(losses: Tensor, batch: Mapping[str, Any]) -> None:
    """Raise FloatingPointError naming the first sample whose losses (B, S, A) are not all finite."""
    bad = (~losses.isfinite().flatten(1).all(dim=1)).nonzero().flatten().tolist()
    if bad:
        raise FloatingPointError(
            f"The loss of {sample_name(batch, bad[0])} is not finite ({len(bad)} of {len(losses)} samples of this batch). "
            "Training stops here, so the last checkpoint is good. Look at this frame's inputs; if all samples are affected, "
            "lower --policy.optimizer_lr."
        )


def sample_name(batch: Mapping[str, Any], row: int) -> str:
    """A sample as an error names it: its dataset index, where the batch has one."""
    index = batch.get("index")
    if index is None:
        return f"sample {row} of the batch"
    return f"the frame with dataset index {int(index.flatten()[row])}"
