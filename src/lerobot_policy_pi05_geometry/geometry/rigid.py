"""Rigid transforms (..., 4, 4): `a_T_b` maps points from frame b into frame a, translations in metres."""

import torch
from torch import Tensor

RIGID_TOLERANCE = 1e-3
FARTHEST = 100.0  # metres from the base: more are millimetres


def identity_rows() -> list[list[float]]:
    return [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def as_matrix(rows: list[list[float]], what: str) -> Tensor:
    """4 rows of 4 numbers -> (4, 4) float64. Raises ValueError unless they are a rigid transform."""
    if not len(rows) == 4 or any(len(row) != 4 for row in rows):
        raise ValueError(f"{what} must be 4 x 4, that is 4 rows of 4 numbers.")
    pose = torch.tensor(rows, dtype=torch.float64)
    check_rigid(pose, what)
    return pose


def compose(first: Tensor, second: Tensor) -> Tensor:
    """The product of (..., 4, 4) and (..., 4, 4), without a matrix product, which a GPU may round to TF32."""
    return (first[..., :, :, None] * second[..., None, :, :]).sum(dim=-2)


def inverse(pose: Tensor) -> Tensor:
    """`b_T_a` of `a_T_b`, (..., 4, 4)."""
    rotation = pose[..., :3, :3].mT
    inverted = torch.zeros_like(pose)
    inverted[..., :3, :3] = rotation
    inverted[..., :3, 3] = -(rotation * pose[..., None, :3, 3]).sum(dim=-1)
    inverted[..., 3, 3] = 1.0
    return inverted


def check_rigid(pose: Tensor, what: str) -> None:
    """Raise ValueError unless pose, (..., 4, 4), is rotation and translation."""
    if pose.shape[-2:] != (4, 4):
        raise ValueError(f"{what} must be 4 x 4, got shape {tuple(pose.shape)}.")
    pose = pose.detach().cpu().double()
    rotation = pose[..., :3, :3]
    error = (rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().amax(dim=(-1, -2))
    last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    error = torch.maximum(error, (pose[..., 3, :] - last_row).abs().amax(dim=-1))
    good = pose.isfinite().all(dim=-1).all(dim=-1) & (error < RIGID_TOLERANCE) & (torch.linalg.det(rotation) > 0)
    if not good.all():
        raise ValueError(
            f"{what} must be a rigid transform (a rotation matrix with determinant 1, a translation in metres, and the "
            f"last row 0 0 0 1): the error is {error.max().item():.3g}; give base_T_camera with OpenCV axes."
        )
    if (pose[..., :3, 3].abs() > FARTHEST).any():
        raise ValueError(f"{what} has a translation of more than {FARTHEST:.0f} m; give metres, not millimetres.")
