"""What kinds of joints mean for a calibration: how their motions compare, and whose offsets a recording can tell."""

import numpy as np
import torch

from ..geometry.kinematics import ForwardKinematics, joint_kinds

# Metres of a prismatic joint that count as much as a radian of a revolute one: 1 degree moves what is 10 cm away by 1.7 mm, and a
# link of a small arm is about as long.
LEVER = 0.1
_PARALLEL = 1e-3  # radians, and metres: what is nearer, no recording tells apart


def levers(kinematics: ForwardKinematics) -> np.ndarray:
    """Per joint (J,) what its values are divided by to be compared with angles in radians: 1, or `LEVER` if it is prismatic."""
    kinds = joint_kinds(kinematics.arm.links)
    return np.array([LEVER if kinds[joint] == "prismatic" else 1.0 for joint in kinematics.joints])


def shown(value: float, lever: float, form: str = ".1f") -> str:
    """A joint's value in radians or metres, as degrees or millimetres. lever: of the joint, by `levers`. form: of the number."""
    return f"{1e3 * value:{form}} mm" if lever == LEVER else f"{np.degrees(value):{form}} degrees"


def tellable(kinematics: ForwardKinematics) -> list[bool]:
    """Whose offsets a recording can tell, one a joint of the chain.

    An offset moves all that comes after the joint. Where its motion commutes with those of all joints before, that is a motion of
    the base; where with all after it, one of what the hand carries. So it is for the first and for the last joint, and for a
    joint that turns about the direction in which the joints before it slide.
    """
    moving = [link for link in kinematics._order if link.joint]
    if not moving:
        return []
    chain = ForwardKinematics(kinematics.arm, [link.name for link in moving])
    poses = chain.poses(torch.zeros(1, len(chain.joints), dtype=torch.float64))[0].numpy()
    screws = []  # rotation and translation of a joint's motion at the base's origin
    for link, pose in zip(moving, poses, strict=True):
        axis = pose[:3, :3] @ np.array(link.axis)
        turns = link.kind == "revolute"
        screws.append((axis, np.cross(pose[:3, 3], axis)) if turns else (np.zeros(3), axis))

    def commute(one: int, other: int) -> bool:
        (turn, shift), (turn_, shift_) = screws[one], screws[other]
        bracket = np.cross(turn, turn_), np.cross(turn, shift_) - np.cross(turn_, shift)
        return bool(np.abs(bracket).max() < _PARALLEL)

    count = len(moving)
    open_ = [
        all(commute(i, j) for j in range(i)) or all(commute(i, j) for j in range(i + 1, count)) for i in range(count)
    ]
    return [
        not all(is_open for link, is_open in zip(moving, open_, strict=True) if link.joint == joint)
        for joint in kinematics.joints
    ]
