"""Arms of a study: what a policy observes, and where geometry enters. Everything else is equal.

An arm is a set of `--policy.*` options of lerobot-train, added to the budget's. So anyone can train it without a study.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

DEPTH, POSE = "depth", "pose"  # what an arm may read besides RGB, and what a faulty sensor may change
_DECIDED_BY_CONVERSION = ("policy.geometry_placement", "policy.geometry_positions", "policy.geometry_gate_openness")


@dataclass(frozen=True)
class Arm:
    """One arm.

    title: shown in the report. options: of lerobot-train, without the dashes. cameras: range of camera poses in its
    training data. reads: depth, and the camera's pose. A fault of what an arm does not read does not affect it.
    blind: its only input is the state, see `blind_inputs`.
    adapts: the arm whose trained policy is adapted to each condition with one demonstration; None: trained itself.
    after: the arm that is trained with the first half of the steps; its policy is converted, and trained with the other half.
    """

    title: str
    options: dict[str, str] = field(default_factory=dict)
    cameras: str = "train"
    reads: frozenset[str] = frozenset()
    blind: bool = False
    adapts: str | None = None
    after: str | None = None

    @property
    def from_scratch(self) -> bool:
        """Whether it is for policies trained from scratch only, since a conversion decides what it changes."""
        return not self.options.keys().isdisjoint(_DECIDED_BY_CONVERSION)


def blind_inputs(shape: Sequence[int]) -> dict[str, str]:
    """Options of a blind arm, for a state of this shape."""
    return {"policy.input_features": json.dumps({"observation.state": {"type": "STATE", "shape": list(shape)}})}


_DEPTH_AND_POSE = frozenset({DEPTH, POSE})


def _geometry(title: str, reads: frozenset[str] = _DEPTH_AND_POSE, after: str | None = None, **changes: str) -> Arm:
    options = {"geometry_source": "rgbd", **changes}
    return Arm(title, {f"policy.{name}": value for name, value in options.items()}, reads=reads, after=after)


# About the faults of the condition "noise", and half of those of "calibration-2" as a standard deviation along each axis.
_AUGMENTATION = {"noise": "0.005", "holes": "0.1", "scale": "0.02", "shift": "0.01", "turn": "1.0"}
_NO_GEOMETRY = {"policy.geometry_source": "none"}

ARMS = {
    "blind": Arm("no camera: the blind floor", _NO_GEOMETRY, blind=True),
    "rgb": Arm("RGB only: plain π0.5", _NO_GEOMETRY),
    "rgb-wide": Arm("RGB only, trained on the wide camera range", _NO_GEOMETRY, cameras="wide"),
    # Rays alone show nothing of the scene, so samples without images would only be lost.
    "rgb+rays": Arm(
        "RGB, and camera rays without depth",
        {"policy.geometry_source": "rays", "policy.image_dropout": "0", "policy.geometry_dropout": "0"},
        reads=frozenset({POSE}),
    ),
    "rgb+modulation": Arm(
        "RGB only, its visual tokens adapted to each condition with one demonstration", _NO_GEOMETRY, adapts="rgb"
    ),
    "geometry": _geometry("RGB, and a geometry segment from depth: the default"),
    "geometry-after-rgb": _geometry("RGB only for half of the steps, then geometry for the other half", after="rgb"),
    "random": Arm("RGB, and as many constant random tokens", {"policy.geometry_source": "random"}),
    "prefix": _geometry("geometry among the VLM's own tokens", geometry_placement="prefix"),
    "gate-closed": _geometry("gate started almost shut", geometry_gate_openness="3e-4"),
    "flow-time": _geometry("segment conditioned on the current flow time", geometry_time="denoise"),
    "own-expert": _geometry("an expert of its own for geometry", geometry_expert="own"),
    "dropout": _geometry("geometry masked in half of the training samples", geometry_dropout="0.5"),
    "pooled": _geometry(
        "points of a cell pooled by a learned map instead of their statistics", geometry_tokens="points"
    ),
    "even-dropout": _geometry(
        "cameras masked in 30 % of the training samples, geometry in 40 %", image_dropout="0.3", geometry_dropout="0.4"
    ),
    "augmented": _geometry(
        "geometry with noise, holes and errors of scale and pose added to depth in training",
        _DEPTH_AND_POSE,
        **{f"depth_augmentation.{name}": size for name, size in _AUGMENTATION.items()},
    ),
    "noise-times": _geometry("flow times drawn closer to noise, from Beta(4, 1)", time_sampling_beta_alpha="4.0"),
    "uniform-times": _geometry("flow times drawn evenly", time_sampling_beta_alpha="1.0"),
    "parallel": _geometry("parallel positions", geometry_positions="parallel"),
    "camera-frame": _geometry("points in the camera's frame", frozenset({DEPTH}), geometry_frame="camera"),
    "grid-4": _geometry("4 x 4 cells", geometry_grid="4"),
    "grid-14": _geometry("14 x 14 cells", geometry_grid="14"),
}


def find_arm(name: str) -> Arm:
    """The arm of this name. Raises ValueError that lists the known names."""
    if name not in ARMS:
        raise ValueError(f"There is no arm '{name}'; choose one of: {', '.join(ARMS)}.")
    return ARMS[name]


def refuse_from_scratch(arm: str) -> None:
    """Raise ValueError for an arm that has no meaning for a converted policy."""
    if find_arm(arm).from_scratch:
        raise ValueError(
            f"Arm '{arm}' is for policies trained from scratch: a conversion decides what it changes. Leave the arm out, or the "
            "pretrained policy."
        )
