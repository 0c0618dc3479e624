"""Forward kinematics: the robot's state -> poses of the arm's links, batched, in plain torch.

An arm is a tree of links as plain numbers (`robot/` reads them from a URDF or MJCF file), so a checkpoint carries it in its
`config.json`. Chosen over placo (one pose at a time), pinocchio (no torch tensors) and pytorch-kinematics (four more
dependencies for what is below).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from .rigid import as_matrix, compose, identity_rows

JOINT_KINDS = ("fixed", "revolute", "prismatic")
RADIANS_PER_UNIT = {"degrees": math.pi / 180, "radians": 1.0}
METRES_PER_UNIT = {"metres": 1.0, "millimetres": 1e-3}


@dataclass
class Link:
    """A link, and the joint by which it hangs on its parent.

    parent: name of the parent link, "" for the root. origin: `parent_T_link` (4 rows of 4, metres) at joint value 0. kind:
    "fixed", "revolute" or "prismatic". joint: name of the joint, "" if fixed. axis: of the joint, in the link's own frame,
    of length 1. scale, shift: the joint moves by scale * value + shift, radians or metres (a joint that mimics another has
    that one's name and its own scale; MJCF's reference position is a shift). joint_kind: of the joint that is named, "" where it
    is `kind`; a jaw may slide with a motor that turns.
    """

    name: str
    parent: str = ""
    origin: list[list[float]] = field(default_factory=identity_rows)
    kind: str = "fixed"
    joint: str = ""
    axis: list[float] = field(default_factory=lambda: [0.0, 0.0, 1.0])
    scale: float = 1.0
    shift: float = 0.0
    joint_kind: str = ""


@dataclass
class StateJoint:
    """Which entry of `observation.state` a joint's value is: joint value = sign * entry in radians or metres + offset.

    joint: its name in the links. state: the entry's name in the dataset. index: its place in the state. unit: degrees or
    radians, metres or millimetres. sign: 1 or -1. offset: radians or metres: LeRobot's zero is the middle of the recorded
    range of a motor, the link file's is where its author put it.
    """

    joint: str
    state: str
    index: int
    unit: str = "degrees"
    sign: int = 1
    offset: float = 0.0


@dataclass
class Arm:
    """An arm. links: parents before children, the root first. joints: those that the state knows; any other stays at 0.

    base_T_root: pose of the root link in the robot's base frame (4 rows of 4), for robots of two arms.
    """

    links: list[Link]
    joints: list[StateJoint]
    base_T_root: list[list[float]] = field(default_factory=identity_rows)  # noqa: N815  the field's name in robotics

    def check(self, name: str) -> None:
        """Raise ValueError, naming the arm, unless this is a usable arm."""
        as_matrix(self.base_T_root, f"base_T_root of arm '{name}'")
        known: dict[str, Link] = {}
        for link in self.links:
            _check_link(link, known, name)
            known[link.name] = link
        if not known:
            raise ValueError(f"Arm '{name}' has no links; write it with `pi05-geometry calibrate arm`.")
        try:
            kinds = joint_kinds(self.links)
        except ValueError as error:
            raise ValueError(f"Arm '{name}': {error}") from error
        for joint in self.joints:
            _check_state_joint(joint, kinds, name)
        names = [joint.joint for joint in self.joints]
        if len(set(names)) < len(names):
            raise ValueError(f"Arm '{name}' names a joint twice: {', '.join(names)}.")

    def check_state_names(self, name: str, names: Sequence[str]) -> None:
        """Raise ValueError, naming the arm, unless the state's entries that it reads have the names it knows them by."""
        for joint in self.joints:
            if joint.index >= len(names) or names[joint.index] != joint.state:
                raise ValueError(
                    f"By the calibration, joint '{joint.joint}' of arm '{name}' is state entry {joint.index}, '{joint.state}', "
                    f"but the dataset's state has {', '.join(names)}; run `pi05-geometry calibrate arm` with this dataset."
                )

    def chain(self, link: str) -> list[Link]:
        """Links from the root down to `link`. Raises ValueError if there is no such link."""
        by_name = {each.name: each for each in self.links}
        if link not in by_name:
            raise ValueError(f"The arm has no link '{link}'; it has {', '.join(by_name)}.")
        path = [by_name[link]]
        while path[-1].parent:
            path.append(by_name[path[-1].parent])
        return path[::-1]


def joint_kinds(links: Sequence[Link]) -> dict[str, str]:
    """Joint -> whether it is "revolute" or "prismatic" itself, in the order of the links.

    Raises ValueError where links say different things of one joint.
    """
    kinds: dict[str, str] = {}
    for link in links:
        kind = link.joint_kind or link.kind
        if link.joint and kinds.setdefault(link.joint, kind) != kind:
            raise ValueError(
                f"joint '{link.joint}' is {kinds[link.joint]} for one link and {kind} for link '{link.name}'; write "
                "the arm again with `pi05-geometry calibrate arm`."
            )
    return kinds


def _check_link(link: Link, known: dict[str, Link], arm: str) -> None:
    where = f"Link '{link.name}' of arm '{arm}'"
    if not link.name or link.name in known:
        raise ValueError(f"{where}: names of links must be there and differ.")
    if (link.parent == "") != (not known) or (link.parent and link.parent not in known):
        raise ValueError(
            f"{where} hangs on '{link.parent}': one root must come first, and parents before their children."
        )
    as_matrix(link.origin, f"{where}: its origin")
    if link.kind not in JOINT_KINDS or (link.kind == "fixed") != (link.joint == ""):
        raise ValueError(f"{where}: kind must be one of {', '.join(JOINT_KINDS)}, and all but fixed need a joint.")
    if link.joint_kind and (link.joint_kind not in ("revolute", "prismatic") or not link.joint):
        raise ValueError(f"{where}: joint_kind must be revolute or prismatic, and only a link with a joint has it.")
    numbers = [*link.axis, link.scale, link.shift]
    if len(link.axis) != 3 or not all(math.isfinite(value) for value in numbers):
        raise ValueError(f"{where}: axis must be three finite numbers, scale and shift finite.")
    if abs(math.dist(link.axis, (0, 0, 0)) - 1) > 1e-6:
        raise ValueError(f"{where}: axis must have length 1, got {link.axis}.")


def _check_state_joint(joint: StateJoint, kinds: dict[str, str], arm: str) -> None:
    where = f"Joint '{joint.joint}' of arm '{arm}'"
    if joint.joint not in kinds:
        raise ValueError(f"{where} is in no link; the links have {', '.join(kinds) or 'no joints'}.")
    units = METRES_PER_UNIT if kinds[joint.joint] == "prismatic" else RADIANS_PER_UNIT
    if joint.unit not in units:
        raise ValueError(
            f"{where}: unit must be {' or '.join(units)}, got {joint.unit!r}; motors that report -100 to 100 of their range "
            "say nothing about angles: record with --robot.use_degrees=true."
        )
    if joint.sign not in (1, -1) or not math.isfinite(joint.offset) or joint.index < 0:
        raise ValueError(f"{where}: sign must be 1 or -1, offset finite, and index 0 or more.")


class ForwardKinematics:
    """Poses of some links of an arm. links: their names.

    Products are written as multiply and sum: a GPU that rounds matrix products to TF32 would misplace a gripper by a
    millimetre.
    """

    def __init__(self, arm: Arm, links: Sequence[str]) -> None:
        self.arm, self.links = arm, list(links)
        chains = [arm.chain(link) for link in links]
        self._order = [link for link in arm.links if any(link in chain for chain in chains)]  # parents first
        self.joints = list(dict.fromkeys(link.joint for link in self._order if link.joint))
        self._at: dict[tuple[torch.device, torch.dtype], _Constants] = {}

    @property
    def unknown_joints(self) -> list[str]:
        """Joints that move these links and that the state does not know."""
        known = {joint.joint for joint in self.arm.joints}
        return [joint for joint in self.joints if joint not in known]

    def values(self, state: Tensor) -> Tensor:
        """State (B, D) in the data's units -> values of `joints` (B, J), radians or metres; 0 where the state knows none."""
        constants = self._constants(state.device, state.dtype)
        if constants.last_entry >= state.shape[-1]:
            raise ValueError(
                f"The arm's joints are entries up to {constants.last_entry} of observation.state, which has {state.shape[-1]}; "
                "the calibration is of another robot."
            )
        entries = state[:, constants.entries]
        return (entries * constants.gains + constants.offsets) * constants.known

    def poses(self, values: Tensor) -> Tensor:
        """Values of `joints` (B, J), radians or metres -> `base_T_link` (B, L, 4, 4) of `links`, metres."""
        constants = self._constants(values.device, values.dtype)
        moved = values[:, constants.columns] * constants.scale + constants.shift  # (B, M), one a link
        sin, cos = moved.sin()[..., None, None], moved.cos()[..., None, None]
        motion = constants.eye + constants.k * sin + constants.kk * (1 - cos)
        motion = motion + constants.slide * moved[..., None, None]
        local = compose(constants.origins, motion)  # (B, M, 4, 4): parent_T_link
        placed: list[Tensor] = []
        for number, parent in enumerate(constants.parents):
            above = constants.root.expand(values.shape[0], 4, 4) if parent < 0 else placed[parent]
            placed.append(compose(above, local[:, number]))
        return torch.stack([placed[number] for number in constants.wanted], dim=1)

    def __call__(self, state: Tensor) -> Tensor:
        """State (B, D) -> `base_T_link` (B, L, 4, 4)."""
        return self.poses(self.values(state))

    def _constants(self, device: torch.device, dtype: torch.dtype) -> "_Constants":
        """Copied to a device once: a copy is waited for."""
        if (device, dtype) not in self._at:
            self._at[device, dtype] = _Constants(self, device, dtype)
        return self._at[device, dtype]


class _Constants:
    """The chain's numbers on a device. K is the axis' cross-product matrix in Rodrigues' formula R = I + K sin + K² (1 - cos)."""

    def __init__(self, kinematics: ForwardKinematics, device: torch.device, dtype: torch.dtype) -> None:
        def tensor(values: Sequence, kind: torch.dtype = dtype) -> Tensor:
            return torch.tensor(values, dtype=torch.float64).to(device=device, dtype=kind)

        arm, order, joints = kinematics.arm, kinematics._order, kinematics.joints
        numbers = {link.name: number for number, link in enumerate(order)}
        self.parents = [numbers.get(link.parent, -1) for link in order]
        self.wanted = [numbers[name] for name in kinematics.links]
        self.root, self.eye = tensor(arm.base_T_root), tensor(identity_rows())
        self.origins = tensor([link.origin for link in order])
        # numpy: the planner builds this where tensors have no values.
        turning = np.stack([_cross(link.axis) if link.kind == "revolute" else np.zeros((4, 4)) for link in order])
        self.k, self.kk = tensor(turning.tolist()), tensor((turning @ turning).tolist())
        self.slide = torch.zeros(len(order), 4, 4, device=device, dtype=dtype)
        for number, link in enumerate(order):
            if link.kind == "prismatic":
                self.slide[number, :3, 3] = tensor(link.axis)
        self.columns = tensor([joints.index(link.joint) if link.joint else 0 for link in order], torch.int64)
        self.scale = tensor([link.scale if link.joint else 0.0 for link in order])
        self.shift = tensor([link.shift if link.joint else 0.0 for link in order])
        if not joints:  # nothing moves, but a column must be there to be multiplied by 0
            joints = [""]
        by_name = {joint.joint: joint for joint in arm.joints}
        known = [by_name.get(name) for name in joints]
        unit = {**RADIANS_PER_UNIT, **METRES_PER_UNIT}
        self.entries = tensor([0 if joint is None else joint.index for joint in known], torch.int64)
        self.last_entry = max((joint.index for joint in known if joint is not None), default=-1)
        self.gains = tensor([0.0 if joint is None else joint.sign * unit[joint.unit] for joint in known])
        self.offsets = tensor([0.0 if joint is None else joint.offset for joint in known])
        self.known = tensor([0.0 if joint is None else 1.0 for joint in known])


def _cross(axis: Sequence[float]) -> np.ndarray:
    x, y, z = axis
    return np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0]], dtype=np.float64)
