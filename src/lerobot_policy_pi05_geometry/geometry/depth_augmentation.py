"""Training augmentation of depth: noise, holes, a wrong depth scale and a wrong pose, as real depth cameras have them.

Every random number is a function of the sample's key (`FlowDraw.key`, which follows from seed, step and dataset index), the
camera and the pixel alone. So a resumed run, another size of micro-batch and another number of processes draw the same. They
are computed on the depth's device by a hash of 32-bit words (lowbias32, by Chris Wellons).
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from .depth import MIN_DEPTH
from .rigid import compose

HOLE_SIDE = 8  # pixels of the square patches that measure nothing
MAX_SCALE = 0.3
_SPAN = 3.0  # standard deviations at which scale and pose are cut off
_WORD = 0xFFFFFFFF
_PURPOSES, _PIXELS = 3, 1 << 26  # kinds of draws per camera, and numbers that each may have
_RIGID, _NOISE, _HOLES = range(_PURPOSES)


@dataclass
class DepthAugmentation:
    """Sizes of what training adds to depth. 0 everywhere: nothing.

    noise: standard deviation in metres at 1 m; it grows with the square of the distance, as a stereo camera's does. holes:
    share of square patches that measure nothing. scale: standard deviation of a factor on all depth of an image, as 0.02.
    shift, turn: standard deviation of the camera's place in metres and of its rotation in degrees, along and about each axis.
    Scale and pose are drawn once for every sample and camera, noise for every pixel.
    """

    noise: float = 0.0
    holes: float = 0.0
    scale: float = 0.0
    shift: float = 0.0
    turn: float = 0.0

    def __bool__(self) -> bool:
        return any(getattr(self, field.name) for field in fields(self))

    def check(self, source: str, frame: str) -> None:
        """Raise ValueError for sizes that cannot be, and where they have no effect. source, frame: of the geometry."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"depth_augmentation.{field.name} must be 0 or more, got {value}.")
        if self.holes >= 1:
            raise ValueError(f"depth_augmentation.holes is a share and must be below 1, got {self.holes}.")
        if self.scale > MAX_SCALE:
            raise ValueError(
                f"depth_augmentation.scale is a relative error and must be {MAX_SCALE} or less, got {self.scale}."
            )
        if self and source != "rgbd":
            raise ValueError(
                f"depth_augmentation changes measured depth, which geometry_source={source} does not have; leave all of it "
                "at 0, or use geometry_source=rgbd."
            )
        if (self.shift or self.turn) and frame != "base":
            raise ValueError(
                "depth_augmentation.shift and turn move the camera in the base frame, so they have no effect with "
                f"geometry_frame={frame}; leave them at 0."
            )


def augment_depth(
    settings: DepthAugmentation, depth: Tensor, valid: Tensor, key: Tensor, camera: int, max_depth: float
) -> tuple[Tensor, Tensor]:
    """Depth (B, 1, H, W) in metres and validity with scale error, noise and holes. key: (B,) int64. camera: its number.

    Returns depth with zeros where it is not valid, and validity, which no pixel gains. max_depth: metres; what noise or scale
    moves beyond it, or below `MIN_DEPTH`, is not measured.
    """
    height, width = depth.shape[-2:]
    found = depth
    if settings.scale:
        found = found * (1 + settings.scale * _few_normal(key, camera)[:, 6]).reshape(-1, 1, 1, 1)
    if settings.noise:
        # Disparity has an error that does not depend on the distance, and depth is inverse disparity: dz = z² · constant.
        normal = _normal(key, camera, _NOISE, height * width).reshape(-1, 1, height, width)
        found = found + settings.noise * found.square() * normal
    if settings.holes:
        valid = valid & ~_holes(settings.holes, key, camera, height, width)
    valid = valid & (found > MIN_DEPTH) & (found < max_depth)
    return found.masked_fill(~valid, 0.0), valid


def jittered(settings: DepthAugmentation, pose: Tensor, key: Tensor, camera: int) -> Tensor:
    """`base_T_camera` (4, 4) or (B, 4, 4) with an error of the camera's place and rotation, (B, 4, 4)."""
    if not (settings.shift or settings.turn):
        return pose
    draws = _few_normal(key, camera)
    moved = torch.zeros(len(key), 4, 4, device=key.device)
    moved[:, :3, :3] = _rotation(math.radians(settings.turn) * draws[:, :3])
    moved[:, :3, 3] = settings.shift * draws[:, 3:6]
    moved[:, 3, 3] = 1.0
    return compose(pose.to(moved).expand(len(key), 4, 4), moved)


def _rotation(vector: Tensor) -> Tensor:
    """Rotation vectors (B, 3), radians -> matrices (B, 3, 3), by Rodrigues' formula."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    square = (cross[..., :, :, None] * cross[..., None, :, :]).sum(dim=-2)
    angle = vector.norm(dim=-1).clamp_min(1e-12)[:, None, None]
    turn = cross * (angle.sin() / angle) + square * (2 * (angle / 2).sin().square() / angle.square())
    return torch.eye(3, device=vector.device) + turn


def _holes(share: float, key: Tensor, camera: int, height: int, width: int) -> Tensor:
    """Pixels (B, 1, H, W) in square patches of which each is a hole with probability `share`. The patches' grid is moved, too."""
    across = width // HOLE_SIDE + 2
    down = height // HOLE_SIDE + 2
    drawn = _uniform(key, camera, _HOLES, down * across + 2)
    moved = (drawn[:, -2:] * HOLE_SIDE).long()  # (B, 2)
    v = (torch.arange(height, device=key.device) + moved[:, :1]) // HOLE_SIDE  # (B, H)
    u = (torch.arange(width, device=key.device) + moved[:, 1:]) // HOLE_SIDE
    patches = (v[:, :, None] * across + u[:, None, :]).flatten(1)
    return (drawn < share).gather(1, patches).reshape(-1, 1, height, width)


def _few_normal(key: Tensor, camera: int) -> Tensor:
    """What is drawn once for a sample and a camera: three turns, three shifts, the scale (B, 7), cut off at 3 deviations."""
    return _normal(key, camera, _RIGID, 7).clamp(-_SPAN, _SPAN)


def _normal(key: Tensor, camera: int, purpose: int, count: int) -> Tensor:
    """Standard normal numbers (B, count), float32."""
    return math.sqrt(2) * torch.erfinv(2 * _uniform(key, camera, purpose, count) - 1)


def _uniform(key: Tensor, camera: int, purpose: int, count: int) -> Tensor:
    """Numbers (B, count) in (0, 1), float32. key: (B,) int64 of 62 bits."""
    assert count <= _PIXELS
    first = (camera * _PURPOSES + purpose) * _PIXELS
    numbers = _mixed(torch.arange(first, first + count, device=key.device) & _WORD)
    low, high = key[:, None] & _WORD, (key[:, None] >> 32) & _WORD
    words = _mixed(_mixed(numbers ^ low) ^ high)
    return ((words >> 9).float() + 0.5) / (1 << 23)  # 23 bits: with 24, the half would round to 1


def _mixed(words: Tensor) -> Tensor:
    """A permutation of 32-bit words (int64) without structure."""
    words = words ^ (words >> 16)
    words = (words * 0x7FEB352D) & _WORD
    words = words ^ (words >> 15)
    words = (words * 0x846CA68B) & _WORD
    return words ^ (words >> 16)
