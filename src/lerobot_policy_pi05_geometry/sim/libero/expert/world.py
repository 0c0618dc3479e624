"""What a scripted expert knows of a scene: the pose and the shape of everything in it.

`World` looks at the simulation at every step. A `Memory` has the mean poses of many layouts and never looks: an expert
that acts on one is the blind plan, the floor of a task.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..scene import LiberoScene

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


class Poses(Protocol):
    """World poses of bodies, collision geometry and sites, indexed as in MuJoCo's data."""

    xpos: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    site_xpos: np.ndarray


@dataclass
class Memory:
    """Mean positions over several layouts; rotations of the first."""

    xpos: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    site_xpos: np.ndarray

    @classmethod
    def of(cls, scene: LiberoScene, placement: str, layouts: int = 10, first_seed: int = 500_000) -> "Memory":
        """Remember `layouts` layouts of a placement, on seeds of its own."""
        seen = []
        for seed in range(first_seed, first_seed + layouts):
            scene.reset(seed, placement)
            data = scene.data
            seen.append([np.array(a) for a in (data.xpos, data.geom_xpos, data.geom_xmat, data.site_xpos)])
        xpos, geom_xpos, geom_xmat, site_xpos = (np.stack(values) for values in zip(*seen, strict=True))
        return cls(xpos.mean(0), geom_xpos.mean(0), geom_xmat[0], site_xpos.mean(0))


class World:
    """A scene as its expert sees it. memory: None looks at the simulation, now."""

    def __init__(self, scene: LiberoScene, memory: Memory | None = None) -> None:
        self.model: Any = scene.model
        self.scene, self._memory = scene, memory
        self._items = {**scene.env.objects_dict, **scene.env.fixtures_dict}
        # The geometry that collides, by the object or fixture that it belongs to; a table and a floor are neither.
        self._geoms: dict[str, list[int]] = {}
        for name, item in self._items.items():
            if hasattr(item, "root_body"):
                geoms = self._geoms_below(self.model.body(item.root_body).id)
                if geoms:
                    self._geoms[name] = geoms

    @property
    def looks(self) -> bool:
        """Whether this world is the present one."""
        return self._memory is None

    @property
    def _poses(self) -> Poses:
        return self.scene.data if self._memory is None else self._memory

    def _geoms_below(self, body: int) -> list[int]:
        found = []
        for geom in range(self.model.ngeom):
            owner = self.model.geom_bodyid[geom]
            while owner not in (body, 0):
                owner = self.model.body_parentid[owner]
            if owner == body and self.model.geom_contype[geom] != 0:
                found.append(geom)
        return found

    def is_region(self, name: str) -> bool:
        """Whether a name of LIBERO's goals is a region (a site), not an object."""
        return name not in self._items

    def position(self, name: str) -> np.ndarray:
        """Origin of an object, or centre of a region, (3,) metres in the world."""
        if self.is_region(name):
            return np.array(self._poses.site_xpos[self.model.site(name).id])
        return np.array(self._poses.xpos[self.model.body(self._items[name].root_body).id])

    def corners(self, geoms: list[int]) -> np.ndarray:
        """Corners of the bounding boxes of geometry, (N, 8, 3) metres in the world."""
        boxes = self.model.geom_aabb[geoms]
        local = boxes[:, None, :3] + _CORNERS * boxes[:, None, 3:]
        rotations = self._poses.geom_xmat[geoms].reshape(-1, 3, 3)
        return np.einsum("nij,nkj->nki", rotations, local) + self._poses.geom_xpos[geoms][:, None]

    def points(self, name: str) -> np.ndarray:
        """Corners of an object's colliding geometry, (N, 3) metres in the world."""
        return self.corners(self._geoms[name]).reshape(-1, 3)

    def part(self, body: str) -> np.ndarray:
        """As `points`, for one body of MuJoCo's by name, such as a drawer."""
        return self.corners(self._geoms_below(self.model.body(body).id)).reshape(-1, 3)

    def geom_boxes(self, body: str) -> np.ndarray:
        """Axis-aligned boxes of a body's geometry, (N, 2, 3): low and high corners, metres in the world."""
        corners = self.corners(self._geoms_below(self.model.body(body).id))
        return np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)

    def obstacles(self, without: str = "") -> np.ndarray:
        """Axis-aligned boxes of all colliding geometry but one object's, (N, 2, 3) metres in the world."""
        geoms = [geom for name, own in self._geoms.items() if name != without for geom in own]
        corners = self.corners(geoms)
        return np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)
