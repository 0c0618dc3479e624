"""The state as the robot reported it, for what normalisation would break: forward kinematics."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE

from ..geometry.keys import RAW_STATE


@ProcessorStepRegistry.register(name="pi05_geometry_raw_state")
@dataclass
class RawStateProcessorStep(ObservationProcessorStep):
    """Copies `observation.state` to `observation.raw_state`, before anything changes it."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        if OBS_STATE not in observation:
            return observation
        return {**observation, RAW_STATE: observation[OBS_STATE]}

    def get_config(self) -> dict[str, Any]:
        return {}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features
