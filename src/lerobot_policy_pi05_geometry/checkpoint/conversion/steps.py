"""Processor steps that one side has and the other has not, in saved pipelines (JSON lists of steps).

Ours: relative actions by steps of our own (data/relative_actions.py), and three steps that change nothing for LeRobot's
π0.5. A source that was saved before LeRobot had relative actions gets the steps, switched off, so that lerobot-train can
switch them on.
"""

from typing import Any

from ...data.normaliser_scale import NormaliserProbeStep, NormaliserScaleStep, constant_of
from ...data.raw_state import RawStateProcessorStep
from ...data.relative_actions import absolute_actions_processor, relative_actions_processor
from ...data.state_width import StateWidthStep

Step = dict[str, Any]

RELATIVE, ABSOLUTE = (
    relative_actions_processor.__name__,
    absolute_actions_processor.__name__,
)  # LeRobot's registered names
_NORMALIZER, _UNNORMALIZER = "normalizer_processor", "unnormalizer_processor"
_WIDTH = "pi05_geometry_state_width"
_RAW_STATE = "pi05_geometry_raw_state"
_SCALE = "pi05_geometry_normaliser_scale"
_OURS_ALONE = (_WIDTH, _RAW_STATE, "pi05_geometry_normaliser_probe", _SCALE)


def step_name(step: Step) -> str:
    """The name by which overrides find a step. Raises KeyError if it has none."""
    return str(step["registry_name"]) if "registry_name" in step else str(step["class"]).rpartition(".")[2]


def preprocessor_to_ours(steps: list[Step]) -> list[Step]:
    """LeRobot's steps, or ours of an earlier version, with ours in their places around the normaliser."""
    width = StateWidthStep(**_settings(steps, _WIDTH))
    before = [width, RawStateProcessorStep(), relative_actions_processor(**_settings(steps, RELATIVE))]
    result = []
    for step in steps:
        if step_name(step) == _NORMALIZER:
            result += [*map(_saved, [*before, NormaliserProbeStep()]), step, _saved(_scale_step(steps, step))]
        elif step_name(step) not in (*_OURS_ALONE, RELATIVE):
            result.append(step)
    return result


def _scale_step(steps: list[Step], normaliser: Step) -> NormaliserScaleStep:
    """The step after a normaliser: with the constant that a policy of ours was trained with, else with LeRobot's."""
    if any(step_name(step) == _SCALE for step in steps):
        return NormaliserScaleStep(**_settings(steps, _SCALE))
    return NormaliserScaleStep(constant=constant_of(normaliser.get("config", {}).get("norm_map", {}).get("STATE")))


def postprocessor_to_ours(steps: list[Step]) -> list[Step]:
    """LeRobot's steps, or ours of an earlier version, with ours after the unnormaliser."""
    absolute = _saved(absolute_actions_processor(**_settings(steps, ABSOLUTE)))
    result = []
    for step in steps:
        if step_name(step) != ABSOLUTE:
            result.append(step)
        if step_name(step) == _UNNORMALIZER:
            result.append(absolute)
    return result


def to_lerobot(steps: list[Step]) -> list[Step]:
    """Our steps without those that LeRobot does not have, relative actions by LeRobot's own steps."""
    return [
        {"registry_name": step_name(step), "config": step.get("config", {})} if "class" in step else step
        for step in steps
        if step_name(step) not in _OURS_ALONE
    ]


def _settings(steps: list[Step], name: str) -> dict[str, Any]:
    """The saved settings of the step with this name, {} if there is none."""
    return next((dict(step.get("config", {})) for step in steps if step_name(step) == name), {})


def _saved(step: Any) -> Step:
    """A step as a saved pipeline has it."""
    kind = type(step)
    registered = getattr(kind, "_registry_name", None)
    name = {"registry_name": registered} if registered else {"class": f"{kind.__module__}.{kind.__name__}"}
    return {**name, "config": step.get_config()}
