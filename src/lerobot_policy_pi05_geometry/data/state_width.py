"""How many dimensions the state has: told in one sentence where LeRobot's normaliser would fail with a shape error."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE


@ProcessorStepRegistry.register(name="pi05_geometry_state_width")
@dataclass
class StateWidthStep(ProcessorStep):
    """Refuses an observation whose state has another width than the training data.

    width: dimensions of the state, None while they are not known. A training batch (one with an action) sets it, since a
    policy may be trained further on another robot; an observation without an action is compared with it.
    """

    width: int | None = None

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Raises ValueError naming both widths."""
        state = (transition.get(TransitionKey.OBSERVATION) or {}).get(OBS_STATE)
        if state is None:
            return transition
        width = state.shape[-1]
        if transition.get(TransitionKey.ACTION) is not None:
            self.width = width
        elif self.width is not None and width != self.width:
            raise ValueError(
                f"{OBS_STATE} has {width} dimensions, but this policy was trained with {self.width}; use a robot or an "
                "environment with the joints of the training data, or train on data of this one."
            )
        return transition

    def get_config(self) -> dict[str, Any]:
        return {"width": self.width}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features
