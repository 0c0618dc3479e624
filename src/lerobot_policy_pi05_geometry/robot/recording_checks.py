"""Recordings from which no calibration follows, each refused with one sentence that says what to do."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..geometry.kinematics import ForwardKinematics
from .hand_eye_problem import View
from .joint_offsets import levers, shown, tellable

if TYPE_CHECKING:
    from .hand_eye import Spread

MIN_VIEWS = 12
MIN_TURN = np.radians(30)  # between the two views whose links are turned furthest from each other
MIN_TILT = np.radians(15)  # of the axes that the link turned about
# Radians of each joint whose offset is sought; metres of a prismatic one times `LEVER`: 14 mm, and 2.6 mm.
MIN_MOTION = np.radians(8)
MAX_OFFSET_SPREAD = np.radians(1.5)
MAX_POSE_SPREAD = 6.0, 1.5  # millimetres, degrees


def check_views(
    kinematics: ForwardKinematics, views: list[View], seen: np.ndarray | None, keep_offsets: bool = False
) -> None:
    """Raise ValueError for views that are too few or too alike, and for a joint that never moved. seen: `camera_T_board`.

    keep_offsets: joints may stand still, since their offsets are known.
    """
    if len(views) < MIN_VIEWS or seen is None:
        raise ValueError(
            f"The board was found in {len(views)} distinct views, but {MIN_VIEWS} are needed; record some 20 poses with the "
            "board well lit and whole in the image, holding still for a second in each."
        )
    values = np.stack([view.values for view in views])
    by = levers(kinematics)
    spans = np.ptp(values, axis=0) / by
    board_turn = _largest_turn(seen[:, :3, :3])
    if board_turn > MIN_TURN and spans.max() < np.radians(0.5):
        raise ValueError(
            "The state never changes although the images do, so it is not this arm's; record with the robot that "
            "moves, and check "
            "which state entries are its joints."
        )
    turns = kinematics.poses(torch.from_numpy(values))[:, 0, :3, :3].numpy()
    if _largest_turn(turns) < MIN_TURN:
        raise ValueError(
            f"The views are too alike: link '{kinematics.links[0]}' turns by {np.degrees(_largest_turn(turns)):.0f} "
            f"degrees at most, but "
            f"{np.degrees(MIN_TURN):.0f} are needed; tilt and roll the hand between poses."
        )
    if _axis_tilt(turns) < MIN_TILT:
        raise ValueError(
            f"The views are too alike: link '{kinematics.links[0]}' turns about one axis only, which leaves the "
            f"camera's place along "
            "it open; tilt the hand in two directions, and roll it."
        )
    still = [number for number, free in enumerate(tellable(kinematics)) if free and spans[number] < MIN_MOTION]
    if still and not keep_offsets:
        needed = " and ".join(dict.fromkeys(shown(MIN_MOTION * by[number], by[number], ".0f") for number in still))
        raise ValueError(
            f"Joint(s) {', '.join(kinematics.joints[number] for number in still)} moved by less than {needed}, so nothing says "
            "what their offset is; move every joint between poses."
        )


def check_determined(kinematics: ForwardKinematics, views: list[View], spread: "Spread") -> None:
    """Raise ValueError if the noise alone leaves an offset or the camera's pose open."""
    by = dict(zip(kinematics.joints, levers(kinematics), strict=True))
    joint, wide = max(
        ((name, value / by[name]) for name, value in spread.offsets.items()), key=lambda pair: pair[1], default=("", 0)
    )
    if wide > MAX_OFFSET_SPREAD:
        span = np.ptp([view.values[kinematics.joints.index(joint)] for view in views])
        raise ValueError(
            f"The views leave the offset of joint '{joint}' open (to {shown(spread.offsets[joint], by[joint])}; it moved over "
            f"{shown(span, by[joint], '.0f')}): move it further, together with the joints before and after it."
        )
    if spread.millimetres > MAX_POSE_SPREAD[0] or spread.degrees > MAX_POSE_SPREAD[1]:
        raise ValueError(
            f"The views leave the camera's pose open (to {spread.millimetres:.0f} mm and {spread.degrees:.1f} "
            f"degrees): bring the board "
            "closer, and tilt the hand further in both directions."
        )


def _largest_turn(rotations: np.ndarray) -> float:
    """Largest angle between two of (V, 3, 3)."""
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    return float(np.arccos(((traces - 1) / 2).clip(-1, 1)).max())


def _axis_tilt(rotations: np.ndarray) -> float:
    """How far the axes that a link turned about are from one line, an angle; by relative rotations of 10 degrees or more."""
    relative = np.einsum("aji,bjk->abik", rotations, rotations).reshape(-1, 3, 3)
    vectors = Rotation.from_matrix(relative).as_rotvec()
    lengths = np.linalg.norm(vectors, axis=1)
    axes = vectors[lengths > np.radians(10)] / lengths[lengths > np.radians(10), None]
    if not len(axes):
        return 0.0
    second = np.sqrt(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-2].clip(0, 1))
    return float(np.arcsin(second))
