"""Hand-eye calibration: a start from OpenCV, then one least-squares problem for mount, board and joint offsets together."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from ..geometry.kinematics import ForwardKinematics
from .board import Board, board_pose
from .hand_eye_problem import HandEyeProblem, Unknowns, View
from .hand_eye_start import closed_form_starts, mean_pose
from .least_squares import deviation_of, fit, fit_roughly, image_error, noise_shown
from .recording_checks import check_determined, check_views
from .suspicions import explain

HOLD_OUT = 5  # every fifth view is kept out of a first fit, and measured
_STARTS = 3  # of the closed-form methods, those that fit best


@dataclass(frozen=True)
class Residuals:
    """Of views that were predicted from the reported state. pixels: root mean square over corners. millimetres, degrees:
    between the
    board's pose as the image shows it and as it is predicted, root mean square over views."""

    pixels: float
    millimetres: float
    degrees: float


@dataclass(frozen=True)
class HandEye:
    """What was found. camera: `link_T_camera` (wrist) or `base_T_camera` (fixed). board: `base_T_board` or `link_T_board`;
    (4, 4).

    offsets: radians or metres per joint of the chain, added to what they were. deviation: root mean square of what the joints
    were off, as a text.
    image: pixels that remain when joints may be off. fitted: of all views. held_out: of views that a first fit did not have.
    fixed_joints: whose offsets stay as they were, by convention or because they were to be kept. views: frames of the dataset.
    """

    camera: np.ndarray
    board: np.ndarray
    offsets: dict[str, float]
    deviation: str
    image: float
    spread: "Spread"
    fitted: Residuals
    held_out: Residuals
    views: list[int]
    fixed_joints: tuple[str, ...]


@dataclass(frozen=True)
class Spread:
    """Standard deviations that follow from the noise: of the camera's pose in millimetres and degrees, of offsets in radians
    or metres."""

    millimetres: float
    degrees: float
    offsets: dict[str, float]


def solve_hand_eye(
    kinematics: ForwardKinematics,
    views: list[View],
    board: Board,
    intrinsics: list[float],
    distortion: list[float],
    wrist: bool,
    start: np.ndarray | None = None,
    keep_offsets: bool = False,
) -> HandEye:
    """Calibrate a camera from views of a board. start: of `HandEye.camera`, tried besides OpenCV's. keep_offsets: of the arm.

    Raises ValueError with one sentence for views that are too few, too alike or contradict each other.
    """
    seen = np.stack([board_pose(board, view.seen, intrinsics, distortion) for view in views]) if views else None
    check_views(kinematics, views, seen, keep_offsets)
    assert seen is not None

    def part(held_out: bool) -> tuple[HandEyeProblem, np.ndarray]:
        rows = [i for i in range(len(views)) if (i % HOLD_OUT == HOLD_OUT - 1) == held_out]
        chosen = [views[i] for i in rows]
        return HandEyeProblem(kinematics, chosen, board.corners, intrinsics, distortion, wrist, keep_offsets), seen[
            rows
        ]

    problem, of_images = part(held_out=False)
    measured = fit(problem, _best_start(problem, of_images, start)).found
    reason = explain(problem, measured, board)
    if reason is not None:
        raise ValueError(reason)
    held_problem, of_held_images = part(held_out=True)
    # What is returned is fitted to all views; how good that is was measured without every fifth.
    whole = HandEyeProblem(kinematics, views, board.corners, intrinsics, distortion, wrist, keep_offsets)
    unmoved = replace(measured, deviations=torch.zeros_like(whole.values))
    solution = fit(whole, unmoved)
    spread = _spread(whole, solution.covariance)
    check_determined(kinematics, views, spread)
    found = solution.found
    return HandEye(
        found.camera.numpy(), found.board.numpy(), dict(zip(kinematics.joints, found.offsets.tolist(), strict=True)),
        noise_shown(whole, deviation_of(whole, found)), image_error(whole, found), spread, residuals_of(whole, found, seen),
        residuals_of(held_problem, measured, of_held_images), [view.frame for view in views],
        tuple(joint for joint, free in zip(kinematics.joints, whole.free.tolist(), strict=True) if not free),
    )  # fmt: skip


def residuals_of(problem: HandEyeProblem, found: Unknowns, seen: np.ndarray) -> Residuals:
    """How far off these views are, predicted from what the joints reported. seen: `camera_T_board` (V, 4, 4) of the images."""
    reported = replace(found, deviations=torch.zeros_like(problem.values))
    pixels = problem.errors(reported).square().sum(dim=1).mean().sqrt()
    predicted = problem.camera_T_board(reported).numpy()
    centre = problem.points.mean(dim=0).numpy()
    apart = np.linalg.norm((predicted - seen) @ centre, axis=1)
    turns = np.linalg.inv(predicted[:, :3, :3]) @ seen[:, :3, :3]
    angles = np.arccos(((np.trace(turns, axis1=1, axis2=2) - 1) / 2).clip(-1, 1))
    return Residuals(
        float(pixels), 1e3 * float(np.sqrt((apart**2).mean())), float(np.degrees(np.sqrt((angles**2).mean())))
    )


def _best_start(problem: HandEyeProblem, seen: np.ndarray, start: np.ndarray | None) -> Unknowns:
    """The best of all starts after a few steps."""
    links = problem.kinematics.poses(problem.values)[:, 0].numpy()
    starts = closed_form_starts(links, seen, problem.wrist)
    if start is not None:
        starts.append((start, _board_of(links, start, seen, problem.wrist)))
    made = [problem.start(*pair) for pair in starts]
    made.sort(key=lambda unknowns: float(problem.errors(unknowns).norm(dim=1).median()))
    rough = [fit_roughly(problem, unknowns) for unknowns in made[:_STARTS]]
    return min(rough, key=lambda fitted: fitted.cost).found


def _board_of(links: np.ndarray, camera: np.ndarray, seen: np.ndarray, wrist: bool) -> np.ndarray:
    return mean_pose((links if wrist else np.linalg.inv(links)) @ camera @ seen)


def _spread(problem: HandEyeProblem, covariance: np.ndarray) -> Spread:
    deviations = np.sqrt(np.diag(covariance).clip(0))
    free = problem.free.numpy()
    named = [joint for joint, is_free in zip(problem.kinematics.joints, free, strict=True) if is_free]
    return Spread(
        1e3 * float(np.linalg.norm(deviations[3:6])),
        float(np.degrees(np.linalg.norm(deviations[:3]))),
        dict(zip(named, deviations[12 : 12 + len(named)].tolist(), strict=True)),
    )
