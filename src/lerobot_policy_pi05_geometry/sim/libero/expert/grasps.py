"""From where to grasp an object from above: along its narrow side, or a bowl by its rim."""

from dataclasses import dataclass

import numpy as np

from .hand import DOWN, Hand, facing
from .world import World

MAX_WIDTH = 0.074  # metres between the open fingers, with some room
BELOW_TOP = 0.022  # of the grip site; the palm begins 24 mm above it
ABOVE_BOTTOM = 0.0135  # of the grip site; fingertips reach 13 mm below it
SHALLOW = 0.010  # metres that a rim is grasped higher where the palm has no room
COLLISION = 5.0  # cost of a sample point inside an obstacle; a radian of turning costs 2
RIM = 0.008  # of the rim's middle inside the outer radius, metres
# Fingers and palm as boxes about the grip site, metres: closing axis, across, up from the tips; measured in the model.
_FINGER = np.array([[0.030, -0.014, -0.013], [0.068, 0.014, 0.050]])
_PALM = np.array([[-0.106, -0.035, 0.026], [0.106, 0.038, 0.25]])  # and the way it comes down


@dataclass(frozen=True)
class Grasp:
    """A grasp. offset: grip site from the object's origin, (3,) metres in the world. rotation: of the grip site."""

    offset: np.ndarray
    rotation: np.ndarray
    cost: float


def _samples(box: np.ndarray) -> np.ndarray:
    axes = [np.linspace(box[0, i], box[1, i], 5) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


_HAND = np.concatenate([_samples(_FINGER), _samples(_FINGER) * [-1, 1, 1], _samples(_PALM)])


def _collisions(site: np.ndarray, rotation: np.ndarray, obstacles: np.ndarray) -> int:
    """How many sample points of the open hand, placed there, are inside an obstacle or within 4 mm of one."""
    # The hand's own third axis points out of it; the boxes count upwards from the tips.
    points = site + (_HAND * [1, 1, -1]) @ rotation.T
    inside = (points[:, None] > obstacles[:, 0] - 0.004) & (points[:, None] < obstacles[:, 1] + 0.004)
    return int(inside.all(axis=-1).any(axis=-1).sum())


def grasps(world: World, name: str, hand: Hand) -> list[Grasp]:
    """Grasps of an object from above, best first: free of others, then with little turning of the hand."""
    points, origin = world.points(name), world.position(name)
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    height = max(low[2] + ABOVE_BOTTOM, high[2] - BELOW_TOP)
    obstacles, found = world.obstacles(without=name), []
    angles = np.radians(np.arange(0, 360, 15))
    widths = [np.ptp(points[:, :2] @ [np.cos(a), np.sin(a)]) for a in angles]
    by_rim = min(widths) > MAX_WIDTH
    for angle, width in zip(angles, widths, strict=True):
        if not by_rim and (angle >= np.pi or width > min(min(widths) + 0.006, MAX_WIDTH)):
            continue
        closing = np.array([np.cos(angle), np.sin(angle), 0.0])
        rotation = hand.nearest(facing(DOWN, closing))
        radius = min(high[0] - low[0], high[1] - low[1]) / 2 - RIM
        # A hand nearer to the bowl's middle needs less room outside; the fingers then draw the bowl along.
        for radial in (radius, radius - 0.018) if by_rim else (0.0,):
            # A shallow grasp keeps the palm above what stands around the bowl.
            for raised in (0.0, SHALLOW) if by_rim else (0.0,):
                site = np.array([*(centre[:2] + radial * closing[:2]), height + raised])
                cost = COLLISION * _collisions(site, rotation, obstacles) + 2.0 * hand.angle_from_home(rotation)
                cost += 1.0 * (by_rim and radial < radius) + 0.5 * (raised > 0)
                found.append(Grasp(site - origin, rotation, cost))
    return sorted(found, key=lambda grasp: grasp.cost)
