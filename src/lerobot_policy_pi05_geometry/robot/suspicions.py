"""Why views contradict each other: each suspicion is a problem with a few unknowns more, and is right if that one fits."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from .board import Board
from .hand_eye_problem import HandEyeProblem, Unknowns, nudged
from .joint_offsets import LEVER, levers
from .least_squares import deviation_of, fit, fit_roughly, fits, image_error, noise_shown

NOTICEABLE = 0.04  # a joint's motion or a board's size is off by 4 %
CERTAIN = 5.0  # and by so many standard deviations
_FEWEST = 4  # views on each side of a moment when something moved


class JointFactors(HandEyeProblem):
    """Each joint may move further, or less far, than the state says."""

    @property
    def more(self) -> int:  # type: ignore[override]
        return self.values.shape[1]

    def _values(self, unknowns: Unknowns) -> Tensor:
        return self.values * (1 + unknowns.more[..., None, :])


class BoardFactor(HandEyeProblem):
    """The board may be larger or smaller than given."""

    more = 1

    def _points(self, unknowns: Unknowns) -> Tensor:
        scaled = self.points[:, :3] * (1 + unknowns.more[..., None, :])
        return torch.cat([scaled, torch.ones_like(scaled[..., :1])], dim=-1)


class SomethingMoved(HandEyeProblem):
    """From view number `since` on, camera and board may be elsewhere."""

    more = 12
    since = 0

    def _camera(self, unknowns: Unknowns) -> Tensor:
        return self._both(unknowns.camera, unknowns.more[..., :6])

    def _board(self, unknowns: Unknowns) -> Tensor:
        return self._both(unknowns.board, unknowns.more[..., 6:])

    def _both(self, pose: Tensor, change: Tensor) -> Tensor:
        before = torch.arange(len(self.views))[:, None, None] < self.since
        return torch.where(before, pose[..., None, :, :], nudged(pose, change)[..., None, :, :])


def explain(problem: HandEyeProblem, found: Unknowns, board: Board) -> str | None:
    """One sentence on why these views contradict each other, as far as they show it; None if they do not.

    A wrong scale may pass for noise, since a mount and joints that are off hide most of it; so scales are looked at in any case.
    """
    told = (
        f"The views contradict each other (joints would have to be {noise_shown(problem, deviation_of(problem, found))} off, and "
        f"{image_error(problem, found):.1f} pixels remain)"
    )
    good = fits(problem, found)
    found = replace(found, deviations=torch.zeros_like(found.deviations))
    size, certain = _fitted(problem, BoardFactor, found)
    if certain is not None and certain[0]:
        return (
            f"{told}: the squares are {1e3 * board.square * (1 + float(size.more)):.1f} mm wide rather than "
            f"{1e3 * board.square:.1f}; measure the print, and give its sides."
        )
    factors, certain = _fitted(problem, JointFactors, found)
    if certain is not None and certain.any():
        joint = int(np.argmax(np.where(certain, factors.more.abs().numpy(), 0)))
        slides = levers(problem.kinematics)[joint] == LEVER
        reason = (
            "is no distance in the joint's unit; say it with `pi05-geometry calibrate arm --unit JOINT=UNIT`."
            if slides
            else "is no angle in degrees; record with --robot.use_degrees=true, and check the joint's unit."
        )
        return (
            f"{told}: joint '{problem.kinematics.joints[joint]}' moves {1 + float(factors.more[joint]):.2f} times as "
            f"far as the state says, so the state {reason}"
        )
    if good:
        return None
    since = _most_likely_moment(problem, found)
    if since is not None:
        return (
            f"{told}: the views before frame {problem.views[since].frame} fit each other, and so do those after it, so the board "
            "or the camera was moved; record again with both fixed."
        )
    return (
        f"{told}: check that the link file is this arm's, that each state entry is the right joint with the right sign, that the "
        "camera's intrinsics are its own, and that the board was fixed while the arm stood still."
    )


def _suspicion(problem: HandEyeProblem, kind: type[HandEyeProblem], found: Unknowns) -> tuple[HandEyeProblem, Unknowns]:
    """The same views as another kind of problem, and its start."""
    suspicion = kind.__new__(kind)
    suspicion.__dict__.update(problem.__dict__)
    return suspicion, replace(found, more=torch.zeros(suspicion.more, dtype=torch.float64))


def _fitted(problem: HandEyeProblem, kind: type[HandEyeProblem], found: Unknowns) -> tuple[Unknowns, np.ndarray | None]:
    """The solution of a suspicion, and which of its numbers (M,) are noticeable and certain; None if it does not fit either."""
    suspicion, start = _suspicion(problem, kind, found)
    fitted = fit(suspicion, fit_roughly(suspicion, start).found)
    if not fits(suspicion, fitted.found):
        return fitted.found, None
    spread = np.sqrt(np.diag(fitted.covariance))[-suspicion.more :]
    size = fitted.found.more.abs().numpy()
    return fitted.found, (size > NOTICEABLE) & (size > CERTAIN * spread)


def _most_likely_moment(problem: HandEyeProblem, found: Unknowns) -> int | None:
    """The view from which on camera or board are elsewhere, if that explains everything."""
    rough = {}
    for since in range(_FEWEST, len(problem.views) - _FEWEST + 1):
        suspicion, start = _suspicion(problem, SomethingMoved, found)
        assert isinstance(suspicion, SomethingMoved)
        suspicion.since = since
        rough[since] = fit_roughly(suspicion, start, steps=6), suspicion
    since, (best, suspicion) = min(rough.items(), key=lambda item: item[1][0].cost)
    return since if fits(suspicion, fit(suspicion, fit_roughly(suspicion, best.found).found).found) else None
