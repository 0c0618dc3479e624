"""Objects placed anew.

LIBERO's initial states hardly vary: an object of interest stands within 29 mm over all fifty. A plan that never looks
then succeeds nearly always, so success says nothing about seeing. Here the objects of interest are moved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .scene import LiberoScene

GAP = 0.015  # metres between the bounding rectangles of two objects
REACH = (0.30, 0.78)  # metres from the base, horizontally: where the gripper reaches the surface pointing down
TRIES = 2000
SETTLE_STEPS = (
    30,
    200,
)  # of the simulation, at least and at most: LIBERO-Object's initial states hang up to 4 cm above the floor
AT_REST = 0.01  # metres and radians a second
SETTLED = 0.02  # metres that an object may slide while it settles


def rectangles(scene: LiberoScene) -> dict[str, np.ndarray]:
    """Bounding rectangle of every object and fixture of the task, world frame: (2, 3), low and high corner, metres."""
    model, data = scene.model, scene.data
    found = {}
    names = {**scene.env.objects_dict, **scene.env.fixtures_dict}
    for name, item in names.items():
        if not hasattr(item, "root_body"):
            continue
        points = body_points(model, data, model.body(item.root_body).id)
        if len(points):
            found[name] = np.stack([points.min(axis=0), points.max(axis=0)])
    return found


def body_points(model, data, body: int) -> np.ndarray:
    """Corners of the colliding geometry of a body and its descendants, (N, 3), world frame, metres."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    points = []
    for geom in range(model.ngeom):
        owner = model.geom_bodyid[geom]
        while owner not in (body, 0):
            owner = model.body_parentid[owner]
        if owner != body or model.geom_contype[geom] == 0:
            continue
        centre, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
        local = centre + corners * half
        points.append(local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return np.concatenate(points) if points else np.zeros((0, 3))


def movable(scene: LiberoScene) -> list[str]:
    """Objects of interest that stand on the table or the floor themselves: those that can be placed anew."""
    problem = scene.env.parsed_problem
    found = []
    for relation, *names in problem["initial_state"]:
        if relation != "on" or names[0] not in scene.env.objects_dict or names[1] not in problem["regions"]:
            continue
        on_surface = problem["regions"][names[1]]["target"] == scene.env.workspace_name
        if on_surface and names[0] in _interest(scene):
            found.append(names[0])
    return found


def _interest(scene: LiberoScene) -> set[str]:
    """Objects of interest, those among them too of which LIBERO names a part (`basket_1_contain_region`)."""
    named = [
        *scene.env.obj_of_interest,
        *(name for goal in scene.env.parsed_problem["goal_state"] for name in goal[1:]),
    ]
    return {name for name in scene.env.objects_dict if any(other.startswith(name) for other in named)}


def place_anew(scene: LiberoScene, spread: float, generator: np.random.Generator) -> bool:
    """Move the objects of interest by up to `spread` metres in x and y, where they touch nothing and can be reached.

    Returns whether such places were found: a fixture may stand where an object could. Raises ValueError if a task has no
    object to move.
    """
    names = movable(scene)
    if not names:
        raise ValueError(
            f"{scene.task.key} has no object of interest that stands on the table or the floor; use placement 'stock'."
        )
    before, boxes = np.array(scene.data.qpos), rectangles(scene)
    for _ in range(TRIES):
        shifts = {name: generator.uniform(-spread, spread, 2) for name in names}
        if not _free(scene, boxes, shifts):
            continue
        _shift(scene, before, shifts)
        if _stays(scene, names):
            return True
    return False


def _free(scene: LiberoScene, boxes: dict[str, np.ndarray], shifts: dict[str, np.ndarray]) -> bool:
    """Whether the shifted rectangles keep their distance from all others, at any height, and within reach."""
    moved = {name: box.copy() for name, box in boxes.items()}
    for name, shift in shifts.items():
        moved[name][:, :2] += shift
        centre = moved[name][:, :2].mean(axis=0) - scene.base[:2]
        if not REACH[0] < np.linalg.norm(centre) < REACH[1]:
            return False
    for name in shifts:
        for other, box in moved.items():
            if other == name:
                continue
            apart = np.maximum(moved[name][0, :2] - box[1, :2], box[0, :2] - moved[name][1, :2])
            if apart.max() < GAP:
                return False
    return True


def _shift(scene: LiberoScene, before: np.ndarray, shifts: dict[str, np.ndarray]) -> None:
    scene.data.qpos[:] = before
    scene.data.qvel[:] = 0
    for name, shift in shifts.items():
        address = scene.model.joint(scene.env.objects_dict[name].joints[-1]).qposadr[0]
        scene.data.qpos[address : address + 2] += shift
    scene.env.sim.forward()


def _stays(scene: LiberoScene, names: list[str]) -> bool:
    """Whether the objects come to rest above where they were put, with the robot held still; leaves the settled state."""
    from ..headless import mujoco

    bodies = [scene.model.body(scene.env.objects_dict[name].root_body).id for name in names]
    start = np.array(scene.data.xpos[bodies])
    robot = np.array(scene.data.qpos[: scene.model.nq])
    arm = [scene.model.joint(j).qposadr[0] for j in scene.env.robots[0].robot_joints]
    fingers = [scene.model.joint(j).qposadr[0] for j in scene.env.robots[0].gripper.joints]
    speeds = [
        range(address, address + 6)
        for address in (scene.model.joint(scene.env.objects_dict[name].joints[-1]).dofadr[0] for name in names)
    ]
    for step in range(SETTLE_STEPS[1]):
        if step >= SETTLE_STEPS[0] and np.abs(scene.data.qvel[np.concatenate(speeds)]).max() < AT_REST:
            break
        mujoco.mj_step(scene.model, scene.data)
        scene.data.qpos[arm + fingers] = robot[arm + fingers]
        scene.data.qvel[[scene.model.joint(j).dofadr[0] for j in scene.env.robots[0].robot_joints]] = 0
    scene.env.sim.forward()
    slid = scene.data.xpos[bodies][:, :2] - start[:, :2]
    return bool(np.linalg.norm(slid, axis=1).max() < SETTLED)
