"""The gripper: where it is, and the action that takes it somewhere.

Actions are robosuite's OSC_POSE: a displacement of the grip site (1 is 5 cm), a rotation vector about the world's axes
(1 is 0.5 rad), and the gripper (-1 opens, 1 closes).
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

POSITION_SCALE, ROTATION_SCALE = 0.05, 0.5  # of action 1: metres, radians
POSITION_GAIN, ROTATION_GAIN = 2.0, 1.0  # share of the error that one step commands; the arm covers some 40 % of it
DOWN = np.array([0.0, 0.0, -1.0])


def facing(approach: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """Rotation of the grip site, (3, 3), whose fingers point along `approach` and close along `closing`, unit vectors."""
    return np.stack([closing, np.cross(approach, closing), approach], axis=1)


class Hand:
    """The gripper's state, read from the simulation, and what it holds on to."""

    def __init__(self, scene: Any) -> None:
        self._site = scene.data.site("gripper0_grip_site")
        self._fingers = [scene.data.joint(f"gripper0_finger_joint{i}") for i in (1, 2)]
        self.home = facing(DOWN, np.array([0.0, 1.0, 0.0]))  # where an episode begins, and all joints have room
        self.gripper = -1.0
        self.careful = False  # near contact: no noise here, please

    @property
    def position(self) -> np.ndarray:
        """Grip site between the fingertips, (3,) metres in the world."""
        return np.array(self._site.xpos)

    @property
    def rotation(self) -> np.ndarray:
        """Rotation of the grip site, (3, 3): x closes the fingers, z points out of the hand."""
        return np.array(self._site.xmat).reshape(3, 3)

    @property
    def opening(self) -> float:
        """Distance between the fingers, metres."""
        return float(self._fingers[0].qpos[0] - self._fingers[1].qpos[0])

    def nearest(self, rotation: np.ndarray) -> np.ndarray:
        """This rotation or the one with the fingers exchanged, whichever is nearer to `home`: the wrist has stops."""
        exchanged = rotation @ np.diag([-1.0, -1.0, 1.0])
        return min((rotation, exchanged), key=self.angle_from_home)

    def angle_from_home(self, rotation: np.ndarray) -> float:
        """Angle between `home` and a rotation, radians."""
        return float(Rotation.from_matrix(rotation @ self.home.T).magnitude())

    def angle_to(self, rotation: np.ndarray) -> float:
        """Angle between the hand's rotation and another, radians."""
        return float(np.linalg.norm(self._turn(rotation)))

    def _turn(self, rotation: np.ndarray) -> np.ndarray:
        return Rotation.from_matrix(rotation @ self.rotation.T).as_rotvec()

    def towards(self, position: np.ndarray, rotation: np.ndarray, speed: float = 1.0) -> np.ndarray:
        """The action, (7,), of a step towards a pose; `speed` bounds its displacement."""
        move = POSITION_GAIN * (position - self.position) / POSITION_SCALE
        for axes in (slice(0, 2), slice(2, 3)):  # apart, so that a long way down leaves the sideways correction alone
            move[axes] *= min(1.0, speed / max(np.abs(move[axes]).max(), 1e-9))
        turn = ROTATION_GAIN * self._turn(rotation) / ROTATION_SCALE
        turn *= min(1.0, 1.0 / max(np.abs(turn).max(), 1e-9))
        return np.concatenate([move, turn, [self.gripper]])

    def still(self) -> np.ndarray:
        """The action that stays here."""
        return np.concatenate([np.zeros(6), [self.gripper]])
