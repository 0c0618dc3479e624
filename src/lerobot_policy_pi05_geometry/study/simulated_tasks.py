"""What a study needs of a simulated task: environment, expert episodes, sizes, cameras. Meta-World's tasks and LIBERO's.

Meta-World's are named as in sim/tasks.py ("button-press-topdown-wide"); LIBERO's by suite, number and placement of
objects ("libero_spatial/2-near"), with "-front" at the end for the front camera alone.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from lerobot.envs.configs import EnvConfig

from ..sim import cameras as metaworld_cameras
from ..sim.configuration import MetaworldRgbdEnv, require_simulator
from ..sim.environment import CAMERA
from ..sim.libero import cameras as libero_cameras
from ..sim.libero.configuration import LiberoRgbdEnv
from ..sim.libero.floors import Floor, read_floors
from ..sim.libero.tasks import PLACEMENTS
from ..sim.record import record
from ..sim.tasks import find_task

_OURS = ("lerobot_policy_pi05_geometry", "lerobot", "torch", "mujoco")
_SUITES = ("libero_spatial", "libero_object", "libero_goal")  # those with scripted experts
_LIBERO = re.compile(r"(?P<suite>libero_\w+)/(?P<number>\d+)-(?P<placement>[a-z]+)(?P<front>-front)?")


@dataclass(frozen=True)
class SimulatedTask(ABC):
    """One task. packages: those that its episodes depend on."""

    name: str
    state_dim: ClassVar[int]
    action_dim: ClassVar[int]
    packages: ClassVar[tuple[str, ...]]

    @property
    @abstractmethod
    def views(self) -> tuple[str, ...]:
        """Names of its cameras; each has RGB and depth."""

    @abstractmethod
    def require(self) -> None:
        """Raise ModuleNotFoundError with installation advice unless its simulator is installed."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """What its episodes depend on, versions aside."""

    @abstractmethod
    def camera_description(self, cameras: str) -> dict[str, Any]:
        """A range of camera poses in numbers. Raises ValueError that lists the known names."""

    @abstractmethod
    def environment(self, cameras: str, image_size: int, sensor: str = "ideal") -> EnvConfig:
        """LeRobot's configuration of its environment."""

    def floor(self) -> Floor | None:
        """How often the expert and a plan that never looks succeed, where it was measured beforehand."""
        return None

    @abstractmethod
    def record(
        self, folder: Path, repo_id: str, episodes: int, cameras: str, image_size: int, seed: int
    ) -> Iterator[tuple[int, bool]]:
        """Record expert episodes; yields (episodes so far, whether the last attempt succeeded)."""


class MetaworldTask(SimulatedTask):
    """A task of sim/tasks.py."""

    state_dim, action_dim = 4, 4
    packages = (*_OURS, "metaworld")

    @property
    def views(self) -> tuple[str, ...]:
        return (CAMERA,)

    def require(self) -> None:
        require_simulator()

    def description(self) -> dict[str, Any]:
        return asdict(find_task(self.name))

    def camera_description(self, cameras: str) -> dict[str, Any]:
        return asdict(metaworld_cameras.find_range(cameras))

    def environment(self, cameras: str, image_size: int, sensor: str = "ideal") -> EnvConfig:
        return MetaworldRgbdEnv(task=self.name, cameras=cameras, sensor=sensor, image_size=image_size)

    def record(
        self, folder: Path, repo_id: str, episodes: int, cameras: str, image_size: int, seed: int
    ) -> Iterator[tuple[int, bool]]:
        return record(folder, repo_id, self.name, episodes, cameras, image_size, seed=seed)


@dataclass(frozen=True)
class LiberoTask(SimulatedTask):
    """A task of LIBERO with its objects placed anew, rendered without shadows and multisampling."""

    suite: str
    number: int
    placement: str
    front_only: bool
    state_dim, action_dim = 8, 7
    packages = (*_OURS, "hf-libero", "robosuite")
    rendering: ClassVar[str] = "fast"

    @property
    def views(self) -> tuple[str, ...]:
        return ("front",) if self.front_only else ("front", "wrist")

    def require(self) -> None:
        from ..sim.libero.installation import require_libero

        require_libero()

    def description(self) -> dict[str, Any]:
        return {**asdict(self), "views": self.views, "rendering": self.rendering}

    def camera_description(self, cameras: str) -> dict[str, Any]:
        return asdict(libero_cameras.find_range(cameras))

    def environment(self, cameras: str, image_size: int, sensor: str = "ideal") -> EnvConfig:
        return LiberoRgbdEnv(
            task=self.suite,
            task_ids=[self.number],
            cameras=cameras,
            placement=self.placement,
            views=list(self.views),
            image_size=image_size,
            rendering=self.rendering,
            sensor=sensor,
        )

    def floor(self) -> Floor | None:
        return read_floors().get((self.suite, self.number, self.placement))

    def record(
        self, folder: Path, repo_id: str, episodes: int, cameras: str, image_size: int, seed: int
    ) -> Iterator[tuple[int, bool]]:
        from ..sim.libero.environment import RgbdLiberoEnv
        from ..sim.libero.record import record as record_libero

        environment = RgbdLiberoEnv(
            self.suite, self.number, cameras, self.placement, self.views, image_size, self.rendering
        )
        return record_libero(folder, repo_id, [environment], episodes, seed)


def simulated_task(name: str) -> SimulatedTask:
    """The task of this name. Raises ValueError that lists the known names or parts of a name."""
    if not name.startswith("libero"):
        find_task(name)
        return MetaworldTask(name)
    found = _LIBERO.fullmatch(name)
    if found is None or found["suite"] not in _SUITES or found["placement"] not in PLACEMENTS:
        raise ValueError(
            f"There is no task '{name}'; a task of LIBERO is a suite ({', '.join(_SUITES)}), a number and a placement of "
            f"objects ({', '.join(PLACEMENTS)}), as libero_spatial/2-near, and -front at the end for the front camera alone."
        )
    return LiberoTask(name, found["suite"], int(found["number"]), found["placement"], found["front"] is not None)
