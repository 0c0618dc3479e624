"""The unknowns of a hand-eye calibration, and where they say that a board's corners are in the images.

```
   wrist camera   base_T_link(joints) · link_T_camera,   a board that lies still:      base_T_board
   fixed camera   base_T_camera,                         a board that the arm carries: link_T_board
```

Unknown besides these two poses: the joints' offsets, and how far each joint was from what it reported in each view. The offset of
the first joint moves the base, that of the last one the mount (or the board): no recording can tell those apart, so they stay as
they are (`joint_offsets.py`). What is found is right for the state that is reported, which is all that a policy gets.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..geometry.kinematics import ForwardKinematics
from ..geometry.rigid import compose, inverse
from .board import Detection
from .joint_offsets import levers, tellable

PIXEL_NOISE = 0.5  # pixels: of a corner that OpenCV has found
_STEP = 1e-6  # radians and metres, of numerical derivatives
# Radians: backlash and resolution of a hobby servo. A prismatic joint has 0.35 mm of it (`levers`).
JOINT_NOISE = np.radians(0.2)


@dataclass(frozen=True)
class View:
    """One image with the board in it. frame: of the dataset. values (J,): of the chain's joints, radians or metres, without
    offsets."""

    frame: int
    values: np.ndarray
    seen: Detection


@dataclass
class Unknowns:
    """camera: `link_T_camera` of a wrist camera, `base_T_camera` of a fixed one. board: `base_T_board`, or `link_T_board`.

    All (4, 4) float64. offsets (J,): radians or metres, added to the joints' values. deviations (V, J): per view, in the same.
    more (M,): what only some problems have (`suspicions.py`). All but `deviations` may have a batch dimension in front.
    """

    camera: Tensor
    board: Tensor
    offsets: Tensor
    deviations: Tensor
    more: Tensor


class HandEyeProblem:
    """Predicted and seen corners of some views. wrist: the camera moves and the board lies still, or the other way round.

    intrinsics: fx, fy, cx, cy of the images. distortion: OpenCV's five numbers. keep_offsets: the arm's are known. free: which
    joints' offsets are unknown. noise (J,): of the joints' values, radians or metres.
    """

    more = 0  # how many numbers a kind of problem has besides

    def __init__(
        self,
        kinematics: ForwardKinematics,
        views: list[View],
        corners: np.ndarray,
        intrinsics: list[float],
        distortion: list[float],
        wrist: bool,
        keep_offsets: bool = False,
    ) -> None:
        self.kinematics, self.wrist, self.views = kinematics, wrist, views
        self.intrinsics, self.distortion = torch.tensor(intrinsics).double(), torch.tensor(distortion).double()
        self.values = torch.from_numpy(np.stack([view.values for view in views]))  # (V, J)
        self.of_view = torch.cat([torch.full((len(view.seen.ids),), i) for i, view in enumerate(views)])  # (N,)
        self.pixels = torch.from_numpy(np.concatenate([view.seen.pixels for view in views]))  # (N, 2)
        points = np.concatenate([corners[view.seen.ids] for view in views])
        self.points = torch.from_numpy(np.concatenate([points, np.ones((len(points), 1))], axis=1))  # (N, 4)
        self.free = torch.tensor([can_tell and not keep_offsets for can_tell in tellable(kinematics)])
        self.noise = JOINT_NOISE * levers(kinematics)

    def start(self, camera: np.ndarray, board: np.ndarray) -> Unknowns:
        """Unknowns with these poses, and every joint where it says it is."""
        zeros = torch.zeros_like(self.values)
        more = torch.zeros(self.more, dtype=torch.float64)
        return Unknowns(torch.from_numpy(camera), torch.from_numpy(board), zeros[0].clone(), zeros, more)

    # What kinds of problems change.

    def _values(self, unknowns: Unknowns) -> Tensor:
        return self.values

    def _points(self, unknowns: Unknowns) -> Tensor:
        return self.points

    def _camera(self, unknowns: Unknowns) -> Tensor:
        """For every view, or the same for all."""
        return unknowns.camera[..., None, :, :]

    def _board(self, unknowns: Unknowns) -> Tensor:
        return unknowns.board[..., None, :, :]

    def camera_T_board(self, unknowns: Unknowns) -> Tensor:  # noqa: N802
        """Of every view, (..., V, 4, 4)."""
        values = self._values(unknowns) + unknowns.offsets[..., None, :] + unknowns.deviations
        base_T_link = self.kinematics.poses(values.flatten(0, -2)).reshape(*values.shape[:-1], 4, 4)
        camera, board = self._camera(unknowns), self._board(unknowns)
        if self.wrist:
            return compose(inverse(compose(base_T_link, camera)), board)
        return compose(inverse(camera), compose(base_T_link, board))

    def predicted(self, unknowns: Unknowns) -> Tensor:
        """Pixels (..., N, 2) where the corners should be, through OpenCV's lens model."""
        poses = self.camera_T_board(unknowns).index_select(-3, self.of_view)[..., :3, :]  # (..., N, 3, 4)
        x, y, z = (poses * self._points(unknowns)[..., None, :]).sum(dim=-1).unbind(-1)
        z = z.clamp_min(1e-3)
        x, y = x / z, y / z
        k1, k2, p1, p2, k3 = self.distortion
        r = x * x + y * y
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
        bent_y = y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
        fx, fy, cx, cy = self.intrinsics
        return torch.stack([fx * bent_x + cx, fy * bent_y + cy], dim=-1)

    def errors(self, unknowns: Unknowns) -> Tensor:
        """Predicted minus seen, (N, 2) pixels."""
        return self.predicted(unknowns) - self.pixels

    # --- as a vector, for least squares -------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """How many numbers change `Unknowns`: two poses, the free offsets, `more`."""
        return 12 + int(self.free.sum()) + self.more

    def moved(self, start: Unknowns, change: Tensor) -> Unknowns:
        """`start` changed by (..., size): a rotation vector and a translation for each pose, then offsets, then `more`."""
        free = int(self.free.sum())
        offsets = start.offsets + change[..., 12 : 12 + free] @ torch.eye(len(self.free)).double()[self.free]
        camera, board = nudged(start.camera, change[..., :6]), nudged(start.board, change[..., 6:12])
        return Unknowns(camera, board, offsets, start.deviations, start.more + change[..., 12 + free :])

    def derivatives(self, start: Unknowns, change: Tensor) -> tuple[Tensor, Tensor]:
        """Of the pixels (2 N), by central differences: by the change (2 N, size), and by the joints of a corner's "
        "own view (2 N, J)."""
        count = self.size + self.values.shape[1]
        steps = _STEP * torch.eye(count, dtype=torch.float64)
        both = torch.cat([steps, -steps])  # (2 count, count)
        moved = self.moved(start, change + both[:, : self.size])
        pixels = self.predicted(replace(moved, offsets=moved.offsets + both[:, self.size :])).flatten(1)
        found = ((pixels[:count] - pixels[count:]) / (2 * _STEP)).mT
        return found[:, : self.size], found[:, self.size :]


def nudged(pose: Tensor, change: Tensor) -> Tensor:
    """Poses (..., 4, 4) turned by a rotation vector in their own frame, and moved in the frame that they stand in; "
    "change (..., 6)."""
    x, y, z = change[..., :3].unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    angle = change[..., :3].norm(dim=-1).clamp_min(1e-12)[..., None, None]
    turn = torch.eye(3, dtype=pose.dtype) + cross * (angle.sin() / angle)  # Rodrigues' formula
    turn = turn + compose(cross, cross) * (2 * (angle / 2).sin().square() / angle.square())
    moved = pose.expand(*change.shape[:-1], 4, 4).clone()
    moved[..., :3, :3] = compose(pose[..., :3, :3], turn)
    moved[..., :3, 3] += change[..., 3:6]
    return moved
