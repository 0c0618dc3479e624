"""LIBERO's original demonstrations: HDF5 files with states, actions, the scene's XML and images without depth.

Layout, of LIBERO's `create_dataset.py` (github.com/Lifelong-Robot-Learning/LIBERO): group `data` with the attribute
`bddl_file_name`; in it one group per demonstration, `demo_0` and so on, with the attribute `model_file` and the datasets
`states` (T, D), `actions` (T, 7) and `obs/agentview_rgb` (T, S, S, 3) uint8, first row at the bottom. `obs[j]` was taken
after `actions[j]`: it shows `states[j + 1]`.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from .tasks import MAX_STEPS, LiberoTask, suite_tasks

NO_OP_MOTION = 1e-4  # norm of the motion below which OpenVLA calls an action a no-op (Kim et al., 2024)
_MAX_XML = 20_000_000  # characters
_IMAGES = "obs/agentview_rgb"


@dataclass(frozen=True)
class Demonstration:
    """One demonstration. states: (T, D) float64. actions: (T, 7) float64. images: (T, S, S, 3) uint8, upright, or None.

    fixtures: body name -> position (3,) and quaternion (w, x, y, z), (4,), which states do not have.
    """

    name: str
    states: np.ndarray
    actions: np.ndarray
    images: np.ndarray | None
    fixtures: dict[str, tuple[np.ndarray, np.ndarray]]

    def kept(self) -> list[int]:
        """Steps that are no no-ops: by OpenVLA's rule, motion below `NO_OP_MOTION` and the gripper as before."""
        before = np.concatenate([self.actions[:1, -1] * np.nan, self.actions[:-1, -1]])
        still = np.linalg.norm(self.actions[:, :-1], axis=1) < NO_OP_MOTION
        same = np.isnan(before) | (self.actions[:, -1] == before)
        return [int(j) for j in np.flatnonzero(~(still & same))]


def task_of(path: Path) -> LiberoTask:
    """The task that a file has demonstrations of. Raises ValueError if none of LIBERO's has its name."""
    with _opened(path) as file:
        stored = file["data"].attrs.get("bddl_file_name", "")
    names = [PurePosixPath(str(stored)).stem, path.stem.removesuffix("_demo")]
    folder = PurePosixPath(str(stored)).parent.name
    suites = [folder] if folder in MAX_STEPS else list(MAX_STEPS)
    for suite in suites:
        for task in suite_tasks(suite):
            if task.name in names:
                return task
    raise ValueError(f"{path} names no task of LIBERO ('{names[0]}'); the file should be called <task>_demo.hdf5.")


def read_demonstrations(path: Path) -> Iterator[Demonstration]:
    """All demonstrations of a file, in the order of their numbers. Raises ValueError for one that is not as LIBERO's."""
    with _opened(path) as file:
        group = file["data"]
        for name in sorted(group, key=lambda name: [int(part) for part in re.findall(r"\d+", name)]):
            yield _read(group[name], f"{path}, {name}")


def _opened(path: Path):
    import h5py

    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read as HDF5 ({error}); give LIBERO's original <task>_demo.hdf5."
        ) from error
    if "data" not in file:
        file.close()
        raise ValueError(f"{path} has no group 'data'; give LIBERO's original <task>_demo.hdf5.")
    return file


def _read(group, where: str) -> Demonstration:
    for name in ("states", "actions"):
        if name not in group:
            raise ValueError(f"{where} has no '{name}'; LIBERO's original demonstrations have it.")
    if "model_file" not in group.attrs:
        raise ValueError(f"{where} has no attribute 'model_file', so its fixtures' poses are unknown.")
    states = np.asarray(group["states"], dtype=np.float64)
    actions = np.asarray(group["actions"], dtype=np.float64)
    if states.ndim != 2 or actions.shape != (len(states), 7) or not len(states):
        raise ValueError(f"{where} has states {states.shape} and actions {actions.shape}; expected (T, D) and (T, 7).")
    if not (np.isfinite(states).all() and np.isfinite(actions).all()):
        raise ValueError(f"{where} has states or actions that are not finite.")
    images = None
    if _IMAGES in group:
        images = np.asarray(group[_IMAGES])
        square = images.ndim == 4 and images.shape[1] == images.shape[2] and images.shape[3] == 3
        if images.dtype != np.uint8 or not square or len(images) != len(states):
            raise ValueError(f"{where} has images {images.shape} {images.dtype}; expected (T, S, S, 3) uint8.")
        images = images[:, ::-1]
    return Demonstration(where, states, actions, images, fixture_poses(str(group.attrs["model_file"]), where))


def fixture_poses(xml: str, where: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Poses of the bodies directly below the world in a MuJoCo XML. Nothing else of the file is used."""
    # Entities are how an XML file takes up memory without end; MuJoCo's writer makes none.
    if len(xml) > _MAX_XML or "<!DOCTYPE" in xml or "<!ENTITY" in xml:
        raise ValueError(f"{where} has a model_file that MuJoCo did not write (too long, or with entities).")
    try:
        world = ET.fromstring(xml).find("worldbody")
    except ET.ParseError as error:
        raise ValueError(f"{where} has a model_file that is not valid XML: {error}.") from error
    poses = {}
    for body in world.findall("body") if world is not None else []:
        position = [float(v) for v in body.get("pos", "0 0 0").split()]
        quaternion = [float(v) for v in body.get("quat", "1 0 0 0").split()]
        if len(position) != 3 or len(quaternion) != 4 or not np.isfinite(position + quaternion).all():
            raise ValueError(f"{where}: body '{body.get('name')}' of model_file has no usable pose.")
        poses[body.get("name", "")] = (np.array(position), np.array(quaternion))
    return poses
