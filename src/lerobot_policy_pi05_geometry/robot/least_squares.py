"""Least squares over the unknowns of a hand-eye calibration (scipy), with exact derivatives (torch).

A joint that is off moves all corners of its view together: their errors are no independent noise. With pixel noise s and
derivatives A by the joints in units of their noise, a view's errors have the covariance s² I + A Aᵀ; its Cholesky factor makes
them independent and of size 1. That is generalised least squares, and the same as solving for every joint of every view with a
prior.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from torch import Tensor

from .hand_eye_problem import PIXEL_NOISE, HandEyeProblem, Unknowns
from .joint_offsets import levers, shown

MAX_DEVIATION = 3.0  # times the noise of a joint: more is no noise
MAX_IMAGE = 2.0  # pixels that remain when joints may be off
_ROUNDS = 2  # the covariance is computed anew at what was found


class Fitted(NamedTuple):
    """cost: half the sum of squared errors in units of their noise. covariance: of the vector of changes."""

    cost: float
    found: Unknowns
    covariance: np.ndarray


def fit_roughly(problem: HandEyeProblem, start: Unknowns, steps: int = 15) -> Fitted:
    """A few steps that take every error for noise of one pixel."""
    return _solve(problem, start, [np.eye(2 * len(view.seen.ids)) for view in problem.views], steps)


def fit(problem: HandEyeProblem, start: Unknowns) -> Fitted:
    """To the end. What is found knows how far every joint was off in every view, too."""
    for _ in range(_ROUNDS):
        fitted = _solve(problem, start, _covariance_factors(problem, start), steps=30)
        start = fitted.found
    return fitted._replace(found=with_deviations(problem, start))


def _solve(problem: HandEyeProblem, start: Unknowns, factors: list[np.ndarray], steps: int) -> Fitted:
    """A Huber loss keeps wrongly found corners from deciding. factors: Cholesky factors of the views' covariances."""

    def whitened(rows: Tensor) -> np.ndarray:
        """Rows (2 N, ...) of all views in units of their noise."""
        parts = zip(factors, _of_views(problem, rows), strict=True)
        return np.concatenate([solve_triangular(factor, part, lower=True) for factor, part in parts])

    result = least_squares(
        lambda x: whitened(problem.errors(problem.moved(start, torch.from_numpy(x))).flatten()),
        np.zeros(problem.size),
        jac=lambda x: whitened(problem.derivatives(start, torch.from_numpy(x))[0]),
        x_scale="jac",
        loss="huber",
        f_scale=4.0,
        ftol=1e-6,
        max_nfev=steps,
    )
    values, vectors = np.linalg.eigh(result.jac.T @ result.jac)
    # A direction that no error sees has no information: its variance is as good as infinite.
    variances = 1 / np.maximum(values, 1e-9 * values.max())
    return Fitted(float(result.cost), problem.moved(start, torch.from_numpy(result.x)), vectors * variances @ vectors.T)


def _of_views(problem: HandEyeProblem, rows: Tensor) -> list[np.ndarray]:
    """Rows (2 N, ...) of the pixels of all corners, one array a view."""
    ends = np.cumsum([2 * len(view.seen.ids) for view in problem.views])
    return np.split(rows.numpy(), ends[:-1])


def _covariance_factors(problem: HandEyeProblem, at: Unknowns) -> list[np.ndarray]:
    _, by_joints = problem.derivatives(at, torch.zeros(problem.size, dtype=torch.float64))
    return [
        np.linalg.cholesky(PIXEL_NOISE**2 * np.eye(len(part)) + part @ part.T)
        for part in _of_views(problem, by_joints * torch.from_numpy(problem.noise))
    ]


def with_deviations(problem: HandEyeProblem, found: Unknowns) -> Unknowns:
    """What was found, and the most probable deviation of every joint in every view (ridge regression, a view at a time)."""
    found = replace(found, deviations=torch.zeros_like(found.deviations))
    _, by_joints = problem.derivatives(found, torch.zeros(problem.size, dtype=torch.float64))
    errors = _of_views(problem, problem.errors(found).flatten())
    prior = np.diag((PIXEL_NOISE / problem.noise) ** 2)
    deviations = [
        -np.linalg.solve(part.T @ part + prior, part.T @ error)
        for part, error in zip(_of_views(problem, by_joints), errors, strict=True)
    ]
    return replace(found, deviations=torch.from_numpy(np.stack(deviations)))


def deviation_of(problem: HandEyeProblem, found: Unknowns) -> float:
    """By how many times their noise joints had to be off: root mean square over a view's joints, of the median view."""
    return float((found.deviations / torch.from_numpy(problem.noise)).square().mean(dim=1).sqrt().median())


def noise_shown(problem: HandEyeProblem, times: float) -> str:
    """So many times the joints' noise, in degrees, and in millimetres if there are prismatic joints."""
    kinds = {lever: times * noise for lever, noise in zip(levers(problem.kinematics), problem.noise, strict=True)}
    return " and ".join(shown(kinds[lever], lever, ".2f") for lever in sorted(kinds, reverse=True))


def image_error(problem: HandEyeProblem, found: Unknowns) -> float:
    """Pixels that remain when joints may be off: the median corner's, as a root mean square (1.2 medians of a plane's noise)."""
    return 1.2 * float(problem.errors(found).norm(dim=1).median())


def fits(problem: HandEyeProblem, found: Unknowns) -> bool:
    """Whether what remains is noise."""
    return deviation_of(problem, found) <= MAX_DEVIATION and image_error(problem, found) <= MAX_IMAGE
