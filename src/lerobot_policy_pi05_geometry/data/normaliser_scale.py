"""What the normaliser does to a dimension, measured: two steps around LeRobot's normaliser.

A saved pipeline is rebuilt step by step, so no step knows the statistics of another. Every normalisation is affine, so two
probe rows, zeros and a large number, show its scale: N(M) - N(0) = scale * M. The first step appends the probe rows to state
and action, the normaliser treats them like any other row, and the second step takes them off and uses the scale:

* A state dimension without width has a scale of 2 / eps. Whatever arrives there is written into the prompt as the
  dimension's constant was in training. Otherwise 0.001 instead of 0.0 would move the prompt's number from 0 to 255.
* The anchor of relative actions (relative_actions.py) is the state times the action's scale.
"""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import NormalizationMode, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from .relative_actions import ACTION_ANCHOR

PROBE = (
    2.0**15
)  # a power of two, so that dividing by it is exact; large, so that the rounding of the mean does not matter
NO_WIDTH = 5e7  # a scale above it comes from LeRobot's eps of 1e-8 in place of a width


def constant_of(mode: NormalizationMode | str | None) -> float:
    """What LeRobot's normaliser makes of the constant of a dimension without width, by its mode or the mode's value."""
    return 0.0 if mode in (NormalizationMode.MEAN_STD, NormalizationMode.MEAN_STD.value) else -1.0


@ProcessorStepRegistry.register(name="pi05_geometry_normaliser_probe")
@dataclass
class NormaliserProbeStep(ProcessorStep):
    """Before the normaliser: appends the probe rows to state (B, D) and, for relative actions, to action (..., S, A)."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        state = observation.get(OBS_STATE)
        if state is not None:
            observation[OBS_STATE] = _with_probes(state if state.is_floating_point() else state.float())
            transition[TransitionKey.OBSERVATION] = observation
        anchor = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get(ACTION_ANCHOR)
        if anchor is not None:
            action = transition.get(TransitionKey.ACTION)
            # An observation without an action: the normaliser stretches the single column to the action's width.
            transition[TransitionKey.ACTION] = _with_probes(anchor.new_empty(0, 1) if action is None else action)
        return transition

    def get_config(self) -> dict[str, Any]:
        return {}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


@ProcessorStepRegistry.register(name="pi05_geometry_normaliser_scale")
@dataclass
class NormaliserScaleStep(ProcessorStep):
    """After the normaliser: takes the probe rows off, settles dimensions without width, and scales the anchor.

    constant: of a state dimension without width, see `constant_of`. The default is that of quantiles and of min and max.
    """

    constant: float = -1.0

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        state = observation.get(OBS_STATE)
        if state is not None:
            state, scale = _without_probes(state)
            # A value that is no number stays one, so that the prompt step refuses it.
            observation[OBS_STATE] = state.masked_fill((scale > NO_WIDTH) & state.isfinite(), self.constant)
            transition[TransitionKey.OBSERVATION] = observation
        data = dict(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        if ACTION_ANCHOR in data:
            action, scale = _without_probes(transition[TransitionKey.ACTION])
            transition[TransitionKey.ACTION] = action if action.numel() else None
            anchor = data[ACTION_ANCHOR]
            width = anchor.shape[-1] if scale.numel() == 1 else scale.numel()  # not normalised: 1 for every dimension
            data[ACTION_ANCHOR] = anchor[:, :width] * scale.to(anchor)
            transition[TransitionKey.COMPLEMENTARY_DATA] = data
        return transition

    def get_config(self) -> dict[str, Any]:
        return {"constant": self.constant}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def _with_probes(values: Tensor) -> Tensor:
    """(..., N, D) -> (..., N + 2, D), with rows of zeros and of PROBE at the end."""
    probes = values.new_tensor([[0.0], [PROBE]]).expand(*values.shape[:-2], 2, values.shape[-1])
    return torch.cat([values, probes], dim=-2)


def _without_probes(values: Tensor) -> tuple[Tensor, Tensor]:
    """(..., N + 2, D) -> (..., N, D) and the scale (D,)."""
    zero, large = values[..., -2:, :].reshape(-1, 2, values.shape[-1])[0]
    return values[..., :-2, :], (large - zero) / PROBE
