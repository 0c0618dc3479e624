"""Where a hand-eye calibration starts from: OpenCV's closed-form methods, which know nothing of offsets or noise."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

_HAND_EYE = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
_ROBOT_WORLD = ("SHAH", "LI")


def closed_form_starts(
    base_T_link: np.ndarray,  # noqa: N803  frames in names, as everywhere
    camera_T_board: np.ndarray,  # noqa: N803
    wrist: bool,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs (camera, board) as in `Unknowns`, one a method that gave finite numbers; (V, 4, 4) each of what is given.

    A fixed camera is the same problem with the link's poses inverted: `base_T_camera` takes the place of `link_T_camera`.
    """
    moving = base_T_link if wrist else np.linalg.inv(base_T_link)
    starts = []
    for name in _HAND_EYE:
        turn, shift = cv2.calibrateHandEye(
            list(moving[:, :3, :3]), list(moving[:, :3, 3]), list(camera_T_board[:, :3, :3]),
            list(camera_T_board[:, :3, 3]), method=getattr(cv2, f"CALIB_HAND_EYE_{name}"),
        )  # fmt: skip
        starts.append(_pose(turn, shift))
    for name in _ROBOT_WORLD:
        inverted = np.linalg.inv(moving)
        _, _, turn, shift = cv2.calibrateRobotWorldHandEye(
            list(camera_T_board[:, :3, :3]), list(camera_T_board[:, :3, 3]), list(inverted[:, :3, :3]),
            list(inverted[:, :3, 3]), method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}"),
        )  # fmt: skip
        starts.append(np.linalg.inv(_pose(turn, shift)))
    usable = [camera for camera in starts if np.isfinite(camera).all() and np.linalg.det(camera[:3, :3]) > 0]
    return [(camera, mean_pose(moving @ camera @ camera_T_board)) for camera in usable]


def mean_pose(poses: np.ndarray) -> np.ndarray:
    """Mean rotation and median translation of poses (V, 4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix()
    pose[:3, 3] = np.median(poses[:, :3, 3], axis=0)
    return pose


def _pose(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = np.ravel(shift)
    if np.isfinite(turn).all() and abs(np.linalg.det(turn)) > 0.5:
        pose[:3, :3] = Rotation.from_matrix(turn).as_matrix()  # some methods return what is no exact rotation
    else:
        pose[:] = np.nan
    return pose
