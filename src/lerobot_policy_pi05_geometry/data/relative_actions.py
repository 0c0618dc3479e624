"""Relative actions: trained as differences to the state, absolute as soon as a chunk is predicted.

A relative action is an action minus the state that the policy saw when it predicted the chunk. LeRobot's own steps add the
state of the current tick instead: its preprocessor keeps the last state, and its postprocessor adds that to whatever action
it gets. An action that waited in a queue is then added to a state that it was not predicted from, and the target drifts.

Here no step keeps anything:

```
training    action - state ──► normaliser ──► policy.forward
acting      state ──► `action_anchor` in the batch ──► policy: chunk + anchor ──► queue ──► unnormaliser ──► robot
```

`action_anchor` (B, A) is the state in the units of normalised actions (normaliser_scale.py). The policy adds it to a chunk
as it predicts it. Queued actions are absolute from then on, and so are the remaining actions that real-time chunking hands
back; the policy subtracts the anchor of the new observation from those.

The two steps have the names of LeRobot's, in lower case: lerobot-train switches relative actions on with overrides of
`relative_actions_processor` and `absolute_actions_processor`, and LeRobot finds a step without a registered name by the
name of its class. They do not derive from LeRobot's steps, since its rollout refuses those without real-time chunking.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, RelativeActionsProcessorStep, to_relative_actions
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

ACTION_ANCHOR = "action_anchor"  # key in the complementary data, and in the batch


@dataclass
class relative_actions_processor(ProcessorStep):  # noqa: N801 (see the module's text)
    """Makes the actions of a training batch relative, and puts the state that they are relative to beside every batch.

    enabled: whether actions are relative. exclude_joints: actions whose name contains one of these stay absolute.
    action_names: names of the action's dimensions; without them every dimension is relative.
    """

    enabled: bool = False
    exclude_joints: list[str] = field(default_factory=list)
    action_names: list[str] | None = None

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Subtract the state from the action, if there is one; add `action_anchor` (B, D), in the state's units.

        Raises ValueError if there is no state, or fewer state dimensions than relative action dimensions.
        """
        if not self.enabled:
            return transition
        transition = transition.copy()
        state = (transition.get(TransitionKey.OBSERVATION) or {}).get(OBS_STATE)
        if state is None:
            raise ValueError(
                f"Relative actions are relative to {OBS_STATE}, which is missing; add it, or train with "
                "--policy.use_relative_actions=false."
            )
        action = transition.get(TransitionKey.ACTION)
        if action is not None:
            if state.shape[-1] < action.shape[-1]:
                raise ValueError(
                    f"Relative actions need a state dimension for each of the {action.shape[-1]} action dimensions, but "
                    f"{OBS_STATE} has {state.shape[-1]}; train with --policy.use_relative_actions=false."
                )
            transition[TransitionKey.ACTION] = to_relative_actions(action, state, self._mask(action.shape[-1]))
        mask = torch.tensor(self._mask(state.shape[-1]), device=state.device)
        data = dict(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        data[ACTION_ANCHOR] = state.where(mask, 0.0)
        transition[TransitionKey.COMPLEMENTARY_DATA] = data
        return transition

    def _mask(self, width: int) -> list[bool]:
        """Which dimensions are relative, by LeRobot's rule for names."""
        mask: list[bool] = RelativeActionsProcessorStep(True, self.exclude_joints, self.action_names)._build_mask(width)
        return mask

    def get_config(self) -> dict[str, Any]:
        return {"enabled": self.enabled, "exclude_joints": self.exclude_joints, "action_names": self.action_names}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


@dataclass
class absolute_actions_processor(ProcessorStep):  # noqa: N801 (see the module's text)
    """Hands actions on: the policy's are absolute already. lerobot-train sets `enabled` of a step with this name."""

    enabled: bool = False

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        return transition

    def get_config(self) -> dict[str, Any]:
        return {"enabled": self.enabled}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def anchor_of(batch: Mapping[str, Any], relative: bool) -> Tensor | None:
    """The anchor (B, A) of a batch, in normalised action units; None for a policy of absolute actions.

    relative: `use_relative_actions` of the policy.
    Raises ValueError if the processors that made the batch disagree with the policy.
    """
    anchor: Tensor | None = batch.get(ACTION_ANCHOR)
    if relative and anchor is None:
        raise ValueError(
            "This policy has use_relative_actions=true, but its processors do not make actions relative (the batch has no "
            f"'{ACTION_ANCHOR}'). Use the processors that were saved with it; write those of an earlier version anew with "
            "`pi05-geometry convert`."
        )
    if anchor is not None and not relative:
        raise ValueError(
            "The processors make actions relative to the state, but the policy has use_relative_actions=false; leave that "
            "setting as the checkpoint has it."
        )
    return anchor


def relative_to(anchor: Tensor, left_over: Tensor) -> Tensor:
    """Absolute actions that real-time chunking hands back, relative to the anchor of the new observation.

    anchor: (B, A). left_over: (T, A) or (B, T, A), normalised. Rows of zeros are LeRobot's padding and stay zeros.
    """
    width = min(anchor.shape[-1], left_over.shape[-1])
    offset = anchor[0] if left_over.ndim == 2 else anchor[:, None]
    moved = left_over.clone()
    moved[..., :width] -= offset[..., :width].to(left_over)
    padding = (left_over == 0).all(dim=-1, keepdim=True)
    return moved.masked_fill(padding, 0.0)
