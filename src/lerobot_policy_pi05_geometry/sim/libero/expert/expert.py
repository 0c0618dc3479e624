"""A LIBERO task's goal -> the skills that reach it."""

from collections.abc import Iterator

import numpy as np

from ..scene import LiberoScene
from .hand import Hand
from .skills import LIFT, Style, pick, place, pull, twist
from .world import Memory, World

KNOB_TURN = 1.1  # radians; the stove is on from 0.5
SETTLING_STEPS = 20  # an object that was let go comes to rest in 1 s


class Expert:
    """One episode's expert. memory: act on remembered poses and never look (the blind plan). style: of the motion.

    Call `act` once per step, with the scene as it is then; after the plan's end the hand stays where it is.

    idle: steps since the plan's end.
    """

    def __init__(self, scene: LiberoScene, memory: Memory | None = None, style: Style | None = None) -> None:
        self.world, self.hand = World(scene, memory), Hand(scene)
        self._style = style or Style()
        self.idle = 0
        self._plan = self._reach_goal(scene.env.parsed_problem["goal_state"])

    def act(self) -> np.ndarray:
        """The next action, (7,) float64 in [-1, 1]."""
        action = next(self._plan, None)
        self.idle += action is None
        return np.clip(self.hand.still() if action is None else action, -1.0, 1.0)

    def _reach_goal(self, goal: list) -> Iterator[np.ndarray]:
        for predicate, *names in goal:
            if predicate in ("on", "in"):
                yield from self._put(*names)
            elif predicate == "open":
                yield from pull(self.hand, self.world, _drawer_body(names[0]), self._style)
            elif predicate == "turnon":
                yield from twist(self.hand, self.world, f"{names[0]}_button", KNOB_TURN, self._style)
            else:
                raise ValueError(f"No scripted expert knows the goal '{predicate} {' '.join(names)}'.")

    def _put(self, name: str, where: str) -> Iterator[np.ndarray]:
        world, hand, style = self.world, self.hand, self._style
        if _is_drawer(where) and not _is_open(world, where):
            yield from pull(hand, world, _drawer_body(where), style)
        for attempt in range(2 if world.looks else 1):
            # The episode may be won: an object that was let go still moves.
            for _ in range(SETTLING_STEPS if attempt else 0):
                yield hand.still()
            origin = world.position(name)
            yield from pick(hand, world, name, style)
            held = hand.position - (world.position(name) if world.looks else origin + np.array([0.0, 0.0, LIFT]))
            yield from place(hand, world, name, _resting_place(world, name, where), style, held)


def _resting_place(world: World, name: str, where: str) -> np.ndarray:
    """Where an object's origin is when it is let go over a region or another object, (3,) metres in the world."""
    centre = world.position(where)
    bottom = world.points(name)[:, 2].min() - world.position(name)[2]
    if world.is_region(where):
        surface = centre[2] + 0.008
    else:
        points = world.points(where)
        surface = points[:, 2].max() + 0.002
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.array([centre[0], centre[1], surface - bottom])


def _is_drawer(region: str) -> bool:
    return region.endswith(("_top_region", "_middle_region", "_bottom_region")) and "cabinet" in region


def _drawer_body(region: str) -> str:
    """`wooden_cabinet_1_middle_region` -> `wooden_cabinet_1_cabinet_middle`."""
    cabinet, part, _ = region.rsplit("_", 2)
    return f"{cabinet}_cabinet_{part}"


def _is_open(world: World, region: str) -> bool:
    state = world.scene.env.object_states_dict[region]
    return bool(state.is_open())
