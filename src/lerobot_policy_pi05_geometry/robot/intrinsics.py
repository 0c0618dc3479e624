"""A camera's intrinsics from images of a board (OpenCV's `calibrateCamera`), for cameras that cannot say them themselves."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_IMAGES

from ..dataset_folder import require_dataset
from ..geometry.camera import CameraCalibration, ColorStream
from ..geometry.rigid import identity_rows
from .board import Board, Detection
from .dataset_views import image_size, to_pixels

MIN_VIEWS = 10
MAX_RESIDUAL = 1.5  # pixels
MAX_SPREAD = 0.01  # of focal lengths and principal point, as shares of the image's width
MIN_PERSPECTIVE = (
    0.05  # by which the scale differs across the board, in a quarter of the views: a tilt of 10 degrees or so
)
MIN_COVERED = 0.5  # of the image's width and height: lens distortion is largest outside of where the board was
_CANDIDATES, _KEPT = 150, 40
_APART = 0.04  # of the image's width: views that differ by less say nothing new
_OUTLIER = 3.0  # times the median view's residual: blurred by motion, or wrongly detected


class Intrinsics(NamedTuple):
    """intrinsics: fx, fy, cx, cy. distortion: OpenCV's k1, k2, p1, p2, k3. size: (width, height).

    residual: root mean square distance of corners in pixels. spread: standard deviation of the four numbers that the noise
    leaves, in pixels. views: how many were used. bend: the farthest that the lens moves a pixel at the image's border.
    """

    intrinsics: list[float]
    distortion: list[float]
    size: tuple[int, int]
    residual: float
    spread: list[float]
    views: int
    bend: float


def read_intrinsics(root: Path, repo_id: str, camera: str, board: Board) -> Intrinsics:
    """Intrinsics of a camera's images from a recording in which the board is shown from many sides.

    Raises ValueError with one sentence for a camera that is not there, and for views from which nothing follows.
    """
    dataset = LeRobotDataset(repo_id, root=require_dataset(root))
    key = f"{OBS_IMAGES}.{camera}"
    if key not in dataset.meta.camera_keys:
        known = ", ".join(dataset.meta.camera_keys) or "no camera"
        raise ValueError(f"The dataset has no images {key}; it has {known}.")
    height, width = image_size(dataset.meta.features[key])
    frames = np.linspace(0, len(dataset) - 1, min(len(dataset), _CANDIDATES)).round().astype(int)
    seen = (board.detect(to_pixels(dataset[int(frame)][key])) for frame in frames)
    return solve_intrinsics(board, [found for found in seen if found is not None], (width, height))


def solve_intrinsics(board: Board, views: list[Detection], size: tuple[int, int]) -> Intrinsics:
    """Intrinsics from views of a board. size: (width, height). Raises ValueError for views from which nothing follows."""
    chosen = _distinct(board, views, size[0])
    _check_views(board, chosen, size)
    try:
        fitted = _fit(board, chosen, size)
        errors = fitted[-1].ravel()
        kept = [view for view, error in zip(chosen, errors, strict=True) if error <= _OUTLIER * np.median(errors)]
        if MIN_VIEWS <= len(kept) < len(chosen):
            chosen, fitted = kept, _fit(board, kept, size)
    except cv2.error as error:
        raise ValueError(_open_told("so that no solution is found")) from error
    residual, matrix, lens, _, _, deviations, _, _ = fitted
    spread = deviations.ravel()[:4]
    found = [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]
    if residual > MAX_RESIDUAL:
        raise ValueError(
            f"The board's corners are {residual:.1f} pixels off what any camera would see; glue the board onto something flat, "
            "check --board, and hold it still."
        )
    if not np.isfinite([*found, *spread]).all() or spread.max() > MAX_SPREAD * size[0]:
        raise ValueError(_open_told(f"to {spread.max():.0f} pixels of {found[0]:.0f}"))
    distortion = [float(value) for value in lens.ravel()[:5]]
    bend = _bend(found, distortion, size)
    return Intrinsics(found, distortion, size, float(residual), spread.tolist(), len(chosen), bend)


def with_intrinsics(name: str, before: CameraCalibration | None, found: Intrinsics) -> CameraCalibration:
    """A camera with these intrinsics of its colour images; where it stands and its depth scale stay as they were.

    Raises ValueError for a camera of which these images say nothing.
    """
    stream = ColorStream(found.intrinsics, list(found.size), identity_rows(), found.distortion)
    if before is None:
        return CameraCalibration(found.intrinsics, list(found.size), stream="color", color=stream)
    if before.rotation:
        raise ValueError(
            f"Camera '{name}' has a rotation of {before.rotation} degrees in the calibration, but the board was seen in images "
            "that are turned already; set its rotation to 0."
        )
    if before.stream == "color":
        return replace(before, intrinsics=found.intrinsics, size=list(found.size), color=stream)
    if before.color is None:
        raise ValueError(
            f"The calibration of camera '{name}' holds for its depth stream, and does not say where its colour stream is; set "
            "its stream to 'color' if depth is aligned to colour."
        )
    return replace(before, color=replace(stream, depth_T_color=before.color.depth_T_color))


def _fit(board: Board, views: list[Detection], size: tuple[int, int]) -> tuple:
    points = [board.corners[view.ids].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    # k3 only helps wide lenses, and makes the border of others worse.
    return tuple(cv2.calibrateCameraExtended(points, pixels, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3))


def _check_views(board: Board, views: list[Detection], size: tuple[int, int]) -> None:
    if len(views) < MIN_VIEWS:
        raise ValueError(
            f"The board was found in {len(views)} distinct views, but {MIN_VIEWS} are needed; show it from 20 sides, tilted, "
            "near and far, and well lit."
        )
    pixels = np.concatenate([view.pixels for view in views])
    covered = np.ptp(pixels, axis=0) / np.array(size)
    if covered.min() < MIN_COVERED:
        raise ValueError(
            f"The board was seen in {100 * covered[0]:.0f} % of the image's width and {100 * covered[1]:.0f} % of its height; "
            f"{100 * MIN_COVERED:.0f} % are needed, so show it at the borders of the image, too."
        )
    # Without perspective any focal length fits, and the solver may be certain of a wrong one.
    perspective = np.quantile([_perspective(board, view) for view in views], 0.75)
    if perspective < MIN_PERSPECTIVE:
        raise ValueError(_open_told(f"with a perspective of {100 * perspective:.0f} %"))


def _perspective(board: Board, view: Detection) -> float:
    """The relative difference of scale across the board, which needs no intrinsics."""
    to_image = _homography(board, view)
    middle = to_image @ np.append(board.corners[:, :2].mean(axis=0), 1.0)
    extent = np.linalg.norm(np.ptp(board.corners[:, :2], axis=0))
    return float(np.linalg.norm(to_image[2, :2]) * extent / abs(middle[2]))


def _homography(board: Board, view: Detection) -> np.ndarray:
    """From the board's plane in metres to pixels, (3, 3)."""
    # A detection has corners that span the plane, so there is one.
    found: np.ndarray = cv2.findHomography(board.corners[view.ids][:, :2], view.pixels)[0]
    return found


def _open_told(how: str) -> str:
    return (
        f"The views are too alike and leave focal lengths and centre open, {how}; tilt the board by 30 degrees or more, in "
        "several directions."
    )


def _distinct(board: Board, views: list[Detection], width: int) -> list[Detection]:
    """Views that differ, in farthest-point order: by where the board's outer corners are, by a homography."""
    outer = board.corners[:, :2]
    low, high = outer.min(axis=0), outer.max(axis=0)
    square = np.array([[low, [high[0], low[1]], high, [low[0], high[1]]]])
    if not views:
        return []
    corners = np.stack([cv2.perspectiveTransform(square, _homography(board, view)).ravel() / width for view in views])
    chosen = [0]
    distance = np.abs(corners - corners[0]).max(axis=1)
    while len(chosen) < _KEPT and distance.max() > _APART:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.abs(corners - corners[chosen[-1]]).max(axis=1))
    return [views[number] for number in sorted(chosen)]


def _bend(intrinsics: list[float], distortion: list[float], size: tuple[int, int]) -> float:
    """Pixels by which the lens moves the image's corners and the middles of its sides, at most."""
    fx, fy, cx, cy = intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, 3), np.linspace(0, size[1] - 1, 3))
    rays = np.stack([(u.ravel() - cx) / fx, (v.ravel() - cy) / fy, np.ones(9)], axis=1)
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    return float(np.linalg.norm(seen.reshape(-1, 2) - np.stack([u.ravel(), v.ravel()], axis=1), axis=1).max())
