"""Arms of a study: what a policy observes, and where its geometry enters. Everything else is equal.

An arm is a set of `--policy.*` options of lerobot-train, added to the budget's. So anyone can train it without a study.
"""

from dataclasses import dataclass, field

BLIND_INPUTS = '{"observation.state": {"type": "STATE", "shape": [4]}}'


@dataclass(frozen=True)
class Arm:
    """One arm.

    title: shown in the report. options: of lerobot-train, without the dashes. cameras: range of camera poses in its
    training data. depth: whether it reads depth. Faults of the depth sensor do not affect an arm that does not.
    """

    title: str
    options: dict[str, str] = field(default_factory=dict)
    cameras: str = "train"
    depth: bool = True


def _geometry(title: str, **changes: str) -> Arm:
    options = {"geometry_source": "rgbd", **changes}
    return Arm(title, {f"policy.{name}": value for name, value in options.items()})


def _no_depth(title: str, source: str, cameras: str = "train", **options: str) -> Arm:
    return Arm(title, {"policy.geometry_source": source, **options}, cameras, depth=False)


ARMS = {
    "blind": _no_depth("no camera: the blind floor", "none", **{"policy.input_features": BLIND_INPUTS}),
    "rgb": _no_depth("RGB only: plain π0.5", "none"),
    "rgb-wide": _no_depth("RGB only, trained on the wide camera range", "none", cameras="wide"),
    "geometry": _geometry("RGB, and a geometry segment from depth: the default"),
    "random": _no_depth("RGB, and as many constant random tokens", "random"),
    "prefix": _geometry("geometry among the VLM's own tokens", geometry_placement="prefix"),
    "gate-closed": _geometry("gate started almost shut", geometry_gate_openness="3e-4"),
    "flow-time": _geometry("segment conditioned on the current flow time", geometry_time="denoise"),
    "own-expert": _geometry("an expert of its own for geometry", geometry_expert="own"),
    "dropout": _geometry("geometry masked in half of the training samples", geometry_dropout="0.5"),
    "parallel": _geometry("parallel positions", geometry_positions="parallel"),
    "camera-frame": _geometry("points in the camera's frame", geometry_frame="camera"),
    "grid-4": _geometry("4 x 4 cells", geometry_grid="4"),
    "grid-14": _geometry("14 x 14 cells", geometry_grid="14"),
}


def find_arm(name: str) -> Arm:
    """The arm of this name. Raises ValueError that lists the known names."""
    if name not in ARMS:
        raise ValueError(f"There is no arm '{name}'; choose one of: {', '.join(ARMS)}.")
    return ARMS[name]
