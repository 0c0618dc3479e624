"""A ChArUco board: its corners, its picture to print, and its corners in an image (OpenCV)."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

# The detector puts the centre of pixel (0, 0) at (0.5, 0.5) (measured on a board that was not even rendered), OpenCV's camera
# model puts it at (0, 0).
_PIXEL_CENTRE = 0.5
MIN_CORNERS = 8  # of one image: fewer say little, and may lie on a line


@dataclass(frozen=True)
class Detection:
    """Corners of a board in an image. ids (K,) int. pixels (K, 2) float64, pixel centres at whole numbers."""

    ids: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Board:
    """A printed board. columns, rows: squares. square, marker: sides in metres, as measured on the print.

    dictionary: of OpenCV's ArUco dictionaries, as 4X4_50.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"A board needs 3 x 3 squares or more, got {self.columns} x {self.rows}.")
        if not 0 < self.marker < self.square < 1:
            raise ValueError(
                f"Sides must be in metres, and the marker's shorter than the square's; got a square of {self.square} and a "
                f"marker of {self.marker}."
            )
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise ValueError(f"OpenCV has no ArUco dictionary {self.dictionary!r}; 4X4_50 or 5X5_100, say, is one.")
        needed = self.columns * self.rows // 2
        if len(self._dictionary.bytesList) < needed:
            raise ValueError(f"Dictionary {self.dictionary} has fewer than the {needed} markers of such a board.")

    @classmethod
    def parse(cls, text: str) -> "Board":
        """A board from "COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY]", sides in millimetres, as 7x5:30:22:4X4_50."""
        try:
            squares, square, marker, *rest = text.split(":")
            columns, rows = squares.lower().split("x")
            return cls(int(columns), int(rows), float(square) / 1e3, float(marker) / 1e3, *rest[:1])
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"A board is written COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], sides in mm, as 7x5:30:22:4X4_50; got {text!r} "
                f"({error})."
            ) from error

    @property
    def _dictionary(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @cached_property
    def _board(self) -> cv2.aruco.CharucoBoard:
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, self._dictionary)

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._board)

    @cached_property
    def corners(self) -> np.ndarray:
        """Inner corners (N, 3) float64 in the board's frame, metres; their place is their id."""
        return np.asarray(self._board.getChessboardCorners(), dtype=np.float64)

    def picture(self, pixels_per_square: int = 200) -> np.ndarray:
        """The board to print, (H, W) uint8, without a margin."""
        return np.asarray(self._board.generateImage((self.columns * pixels_per_square, self.rows * pixels_per_square)))

    def detect(self, image: np.ndarray) -> Detection | None:
        """Corners of the board in an image (H, W, 3) or (H, W) uint8; None if fewer than `MIN_CORNERS` are seen."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        # Among markers that are hidden OpenCV may interpolate corners that all lie on one line: no pose follows from those.
        found = self.corners[ids.ravel(), :2]
        if np.linalg.matrix_rank(found - found.mean(axis=0), tol=1e-6) < 2:
            return None
        return Detection(ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(np.float64) - _PIXEL_CENTRE)


def board_pose(
    board: Board, seen: Detection, intrinsics: list[float], distortion: list[float] | None = None
) -> np.ndarray:
    """`camera_T_board` (4, 4) float64 from one image, by OpenCV's solvePnP."""
    fx, fy, cx, cy = intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    spread = None if distortion is None else np.array(distortion)
    points = board.corners[seen.ids]
    _, turns, shifts, errors = cv2.solvePnPGeneric(points, seen.pixels, matrix, spread, flags=cv2.SOLVEPNP_IPPE)
    best = int(np.argmin(np.ravel(errors)))
    turn, shift = cv2.solvePnPRefineLM(points, seen.pixels, matrix, spread, turns[best].copy(), shifts[best].copy())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose
