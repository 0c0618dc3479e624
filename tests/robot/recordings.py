"""Synthetic hand-eye recordings: an SO-101-like arm, a board and a camera, with noise and offsets that the solver must find."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from lerobot_policy_pi05_geometry.geometry.kinematics import Arm, ForwardKinematics
from lerobot_policy_pi05_geometry.robot.board import Board, Detection
from lerobot_policy_pi05_geometry.robot.hand_eye_problem import View
from tests.geometry.arms import so101_like

BOARD = Board(7, 5, 0.03, 0.022)
INTRINSICS = [600.0, 600.0, 319.5, 239.5]
SIZE = (640, 480)


def turned(x: float, y: float, z: float, shift: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """A pose from angles in degrees about x, y and z, and a translation."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [x, y, z], degrees=True).as_matrix()
    pose[:3, 3] = shift
    return pose


@dataclass
class Recording:
    """camera, board: as in `Unknowns`, the truth. offsets: radians by which the arm's joints are off what the state says."""

    wrist: bool
    random: np.random.Generator
    arm: Arm = field(default_factory=so101_like)
    camera: np.ndarray = field(init=False)
    board: np.ndarray = field(init=False)
    offsets: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        degrees = self.random.uniform(-5, 5, 5)
        self.offsets = np.radians(degrees)
        nudge = turned(*self.random.uniform(-10, 10, 3), tuple(self.random.uniform(-0.01, 0.01, 3)))
        self.kinematics = ForwardKinematics(self.arm, ["gripper"])
        self.middle = np.radians(self.random.uniform(-20, 20, 5))
        link = self.link_poses(self.middle[None])[0]
        away = 0.28 if self.wrist else 0.45
        ahead = turned(
            *self.random.uniform(-15, 15, 3), (-0.1, -0.08, away)
        )  # camera_T_board in the middle of the range
        nudge = turned(*self.random.uniform(-10, 10, 3), tuple(self.random.uniform(-0.01, 0.01, 3)))
        if self.wrist:
            self.camera = turned(-20, 0, 0, (0.0, 0.05, 0.02)) @ nudge
            self.board = link @ self.camera @ ahead
        else:
            self.board = turned(0, 90, 0, (0.02, -0.06, 0.12)) @ nudge
            self.camera = link @ self.board @ np.linalg.inv(ahead)

    def link_poses(self, values: np.ndarray) -> np.ndarray:
        """`base_T_link` (V, 4, 4) of joints (V, J) as they really are, radians."""
        return self.kinematics.poses(torch.from_numpy(values))[:, 0].numpy()

    def camera_T_board(self, values: np.ndarray) -> np.ndarray:  # noqa: N802
        """(V, 4, 4) of joints (V, J) as they really are, radians."""
        links = self.link_poses(values)
        if self.wrist:
            return np.linalg.inv(links @ self.camera) @ self.board
        return np.linalg.inv(self.camera) @ links @ self.board

    def project(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (V, N, 2) of the board's corners, and which of them (V, N) an image shows, from the front."""
        poses = self.camera_T_board(values)
        points = np.einsum("vij,nj->vni", poses[:, :3, :3], BOARD.corners) + poses[:, None, :3, 3]
        away = points.mean(axis=1)
        facing = (poses[:, :3, 2] * away).sum(axis=1) / np.linalg.norm(away, axis=1)
        fx, fy, cx, cy = INTRINSICS
        pixels = points[..., :2] / points[..., 2:].clip(0.01) * [fx, fy] + [cx, cy]
        inside = ((pixels > 5) & (pixels < np.array(SIZE) - 5)).all(axis=2) & (points[..., 2] > 0.1)
        return pixels, inside & (facing > math.cos(math.radians(60)))[:, None]

    def draw(
        self,
        count: int,
        reach: float = 1.0,
        pixel_noise: float = 0.3,
        joint_noise: float = 0.2,
        motion: tuple[float, ...] = (70, 60, 70, 70, 90),
    ) -> list[View]:
        """Views with half of the board or more in the image. The state is off by offsets and noise (degrees).

        reach: of the poses. motion: of each joint to both sides of its middle, degrees.
        """
        found: list[np.ndarray] = []
        for _ in range(200):
            drawn = self.random.uniform(-1, 1, (500, 5))
            values = self.middle + np.radians(motion) * reach * drawn
            found.extend(values[self.project(values)[1].sum(axis=1) >= len(BOARD.corners) // 2])
            if len(found) >= count:
                break
        assert len(found) >= count, f"only {len(found)} of {count} views found"
        true = np.stack(found[:count])
        views = []
        for number, (values, pixels, shown) in enumerate(zip(true, *self.project(true), strict=True)):
            state = values - self.offsets + np.radians(joint_noise) * self.random.normal(size=5)
            seen = pixels[shown] + pixel_noise * self.random.normal(size=(int(shown.sum()), 2))
            views.append(View(10 * number, state, Detection(np.flatnonzero(shown), seen)))
        return views


def make_recording(wrist: bool, seed: int) -> Recording:
    return Recording(wrist, np.random.default_rng(seed))


def aligned_errors(recording: Recording, camera: np.ndarray) -> tuple[float, float]:
    """Millimetres and degrees by which a camera is off, after the rotation that no recording can tell.

    A fixed camera may be turned about the first joint's axis, a wrist camera about the last one's.
    """
    first, last = recording.kinematics._order[1], recording.kinematics._order[-1]
    frame, axis = (np.eye(4), last.axis) if recording.wrist else (np.array(first.origin), first.axis)

    def apart(angle: float) -> tuple[float, float]:
        truth = _about(frame, axis, angle) @ recording.camera
        turn = (np.linalg.inv(truth) @ camera)[:3, :3]
        degrees = np.degrees(np.arccos(((np.trace(turn) - 1) / 2).clip(-1, 1)))
        return 1e3 * float(np.linalg.norm(truth[:3, 3] - camera[:3, 3])), float(degrees)

    best = minimize_scalar(lambda angle: sum(apart(angle)), bounds=(-0.3, 0.3), method="bounded")
    return apart(best.x)


def turned_by_convention(recording: Recording) -> np.ndarray:
    """The camera's pose if the offsets of the first and the last joint are taken for 0, as they are in a calibration."""
    first, last = recording.kinematics._order[1], recording.kinematics._order[-1]
    if recording.wrist:
        return _about(np.eye(4), last.axis, recording.offsets[-1]) @ recording.camera
    return _about(np.array(first.origin), first.axis, -recording.offsets[0]) @ recording.camera


def _about(frame: np.ndarray, axis: list[float], angle: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.array(axis) * angle).as_matrix()
    return frame @ turn @ np.linalg.inv(frame)


def changed(views: list[View], change) -> list[View]:
    """Views with other joint values. change: called with the number of a view and its values."""
    return [replace(view, values=change(number, view.values)) for number, view in enumerate(views)]
