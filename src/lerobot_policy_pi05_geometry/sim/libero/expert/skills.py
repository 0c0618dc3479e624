"""Pick, place, pull and turn: the library that all LIBERO experts are made of.

A skill is a generator of actions, (7,) each: it reads the world and the hand anew before every one. Skills that look can
fail and try again; in a remembered world they go on regardless.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .grasps import Grasp, grasps
from .hand import Hand, facing
from .world import World

Actions = Iterator[np.ndarray]
CLOSE_STEPS, OPEN_STEPS = 12, 8
LIFT = 0.06  # metres straight up after a grasp
LIFTED = 0.02  # metres that an object must have risen to count as held
CLEARANCE = 0.03  # metres above what the hand or its load passes over


@dataclass
class Style:
    """What differs from one demonstration to the next. generator: None is always the plainest path."""

    generator: np.random.Generator | None = None

    def jitter(self, size: float) -> np.ndarray:
        """A displacement of a way point, (3,) metres; never downwards."""
        if self.generator is None:
            return np.zeros(3)
        shift = self.generator.uniform(-size, size, 3)
        return np.array([shift[0], shift[1], abs(shift[2])])

    def speed(self) -> float:
        """Bound of a free motion's action."""
        return 1.0 if self.generator is None else float(self.generator.uniform(0.7, 1.0))

    def choose(self, options: list[Grasp]) -> list[Grasp]:
        """Grasps in the order to try; equally good ones change places."""
        if self.generator is None:
            return options
        good = [grasp for grasp in options if grasp.cost < options[0].cost + 1.0]
        good = [good[i] for i in self.generator.permutation(len(good))]
        return good + options[len(good) :]


def move(
    hand: Hand,
    position: np.ndarray,
    rotation: np.ndarray,
    speed: float = 1.0,
    tolerance: float = 0.01,
    turned: float = 0.1,
    steps: int = 60,
) -> Actions:
    """Go to a pose, until within `tolerance` metres and `turned` radians or for `steps`."""
    for _ in range(steps):
        if np.linalg.norm(position - hand.position) < tolerance and hand.angle_to(rotation) < turned:
            return
        yield hand.towards(position, rotation, speed)


def _higher(position: np.ndarray, by: float) -> np.ndarray:
    return position + np.array([0.0, 0.0, by])


def grip(hand: Hand, closed: bool, steps: int) -> Actions:
    """Close or open the fingers, without moving."""
    hand.gripper = 1.0 if closed else -1.0
    for _ in range(steps):
        yield hand.still()


def height_over(world: World, start: np.ndarray, end: np.ndarray, without: str = "", margin: float = 0.11) -> float:
    """Top of everything that stands between or near two places, metres in the world; -inf if nothing does."""
    boxes = world.obstacles(without)
    low, high = np.minimum(start, end)[:2] - margin, np.maximum(start, end)[:2] + margin
    near = (boxes[:, 1, :2] > low).all(axis=1) & (boxes[:, 0, :2] < high).all(axis=1)
    return float(boxes[near, 1, 2].max(initial=-np.inf))


def pick(hand: Hand, world: World, name: str, style: Style, tries: int = 4) -> Actions:
    """Grasp an object from above and lift it; returns when it is held, or after `tries`."""
    rest = world.position(name)
    for attempt in range(tries if world.looks else 1):
        options = style.choose(grasps(world, name, hand))
        grasp = options[min(attempt, len(options) - 1)]
        above = world.position(name) + grasp.offset
        over = max(height_over(world, hand.position, above) + CLEARANCE + 0.013, above[2] + 0.06)
        if hand.position[2] < over - 0.02:
            yield from move(hand, np.array([*hand.position[:2], over]), grasp.rotation, style.speed(), 0.03)
        yield from move(hand, np.array([*above[:2], over]) + style.jitter(0.02), grasp.rotation, style.speed(), 0.02)
        hand.careful = True
        yield from _descend(hand, world, name, grasp)
        yield from grip(hand, closed=True, steps=CLOSE_STEPS)
        hand.careful = False
        lifted = _higher(hand.position, LIFT)
        yield from move(hand, lifted, grasp.rotation, 0.7, 0.015, steps=20)
        if not world.looks or world.position(name)[2] > rest[2] + LIFTED:
            return
        yield from grip(hand, closed=False, steps=OPEN_STEPS)
        rest = world.position(name)


def _descend(hand: Hand, world: World, name: str, grasp: Grasp) -> Actions:
    """Straight down to the grasp, following the object."""
    for _ in range(60):
        target = world.position(name) + grasp.offset
        error = target - hand.position
        if np.linalg.norm(error) < 0.007 and hand.angle_to(grasp.rotation) < 0.15:
            return
        yield hand.towards(_above_first(hand, target), grasp.rotation, 0.8)


def _above_first(hand: Hand, target: np.ndarray, near: float = 0.006) -> np.ndarray:
    """The target, higher by as much as the hand is still beside it: first above, then down."""
    beside = float(np.linalg.norm((target - hand.position)[:2]))
    height = min(4.0 * max(beside - near, 0.0), max(hand.position[2] - target[2], 0.0))
    return target + np.array([0.0, 0.0, height])


def place(hand: Hand, world: World, name: str, target: np.ndarray, style: Style, held: np.ndarray) -> Actions:
    """Carry what is held to where its origin is at `target`, let go, and move away.

    target: (3,) metres in the world. held: the hand from the object's origin when it was grasped, (3,) metres.
    """
    rotation = hand.rotation
    if world.looks:
        held = hand.position - world.position(name)
    bottom = float(world.points(name)[:, 2].min() - world.position(name)[2])
    goal = target + held
    over = height_over(world, hand.position, goal, without=name) + CLEARANCE - bottom + held[2]
    over = max(over, goal[2] + 0.03, hand.position[2])
    speed = min(style.speed(), 0.8)
    yield from move(hand, np.array([*hand.position[:2], over]), rotation, speed, 0.03, 0.3)
    yield from move(hand, np.array([*goal[:2], over]) + style.jitter(0.015), rotation, speed, 0.025, 0.3)
    hand.careful = True
    for _ in range(60):
        if world.looks:
            goal = target + hand.position - world.position(name)
        if np.linalg.norm(goal - hand.position) < 0.012:
            break
        yield hand.towards(_above_first(hand, goal, 0.012), rotation, 0.6)
    yield from grip(hand, closed=False, steps=OPEN_STEPS)
    hand.careful = False
    yield from move(hand, _higher(hand.position, 0.10), rotation, 0.8, 0.03, steps=20)


def pull(hand: Hand, world: World, drawer: str, style: Style, distance: float = 0.19) -> Actions:
    """Open a drawer by the bar of its handle, with the fingers above and below it.

    drawer: name of MuJoCo's body, whose handle is the part of it that stands out farthest along +y.
    """
    boxes = world.geom_boxes(drawer)
    bar = boxes[boxes[:, 1, 1].argmax()]
    centre = bar.mean(axis=0)
    outwards = np.array([0.0, 1.0, 0.0])
    rotation = hand.nearest(facing(-outwards, np.array([0.0, 0.0, 1.0])))
    ready = centre + 0.12 * outwards
    high = np.array([ready[0] - 0.05, ready[1] + 0.05, max(ready[2] + 0.1, hand.position[2])])
    yield from move(hand, high + style.jitter(0.02), rotation, style.speed(), 0.03, 0.3)
    yield from move(hand, ready + style.jitter(0.01), rotation, style.speed(), 0.02, 0.12)
    hand.careful = True
    yield from move(hand, ready, rotation, 0.5, 0.006, 0.06, steps=30)
    yield from move(hand, centre + 0.004 * outwards, rotation, 0.4, 0.006, 0.08, steps=50)
    yield from grip(hand, closed=True, steps=CLOSE_STEPS)
    yield from move(hand, centre + distance * outwards, rotation, 0.5, 0.02, 0.3, steps=70)
    yield from grip(hand, closed=False, steps=OPEN_STEPS)
    hand.careful = False
    away = hand.position + 0.08 * outwards
    yield from move(hand, away, rotation, 0.8, 0.03, 0.3, steps=25)
    yield from move(hand, away + np.array([-0.05, 0.0, 0.08]), hand.home, 0.8, 0.04, 0.3, steps=40)


def twist(hand: Hand, world: World, knob: str, angle: float, style: Style) -> Actions:
    """Turn a knob about the vertical by `angle` radians, held from above along its narrow side."""
    points = world.part(knob)
    top = points[:, 2].max()
    grip_points = points[points[:, 2] > top - 0.012]
    centre = (grip_points.min(axis=0) + grip_points.max(axis=0)) / 2
    angles = np.radians(np.arange(0, 180, 5))
    widths = [np.ptp(grip_points[:, :2] @ [np.cos(a), np.sin(a)]) for a in angles]
    narrow = angles[int(np.argmin(widths))]
    rotation = hand.nearest(facing(np.array([0.0, 0.0, -1.0]), np.array([np.cos(narrow), np.sin(narrow), 0.0])))
    site = np.array([*centre[:2], top - 0.008])
    over = np.array([*site[:2], max(site[2] + 0.08, height_over(world, hand.position, site) + 0.03)])
    yield from move(hand, over + style.jitter(0.02), rotation, style.speed(), 0.02)
    hand.careful = True
    yield from move(hand, site, rotation, 0.5, 0.006, 0.06, steps=60)
    yield from grip(hand, closed=True, steps=CLOSE_STEPS)
    turned = _about_vertical(angle) @ rotation
    for _ in range(50):
        if hand.angle_to(turned) < 0.1:
            break
        yield hand.towards(site, turned, 0.3)
    yield from grip(hand, closed=False, steps=OPEN_STEPS)
    hand.careful = False
    yield from move(hand, _higher(hand.position, 0.1), hand.rotation, 0.8, 0.03, steps=20)


def _about_vertical(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
