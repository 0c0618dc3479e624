"""URDF and MJCF files -> an arm's links as numbers (`geometry/kinematics.py`). Meshes and inertias are not read."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry.kinematics import Link

_URDF_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}
_MAX_BYTES = 20_000_000  # a link file is some 20 kB; meshes are other files


def read_links(path: str | Path, base: str | None = None) -> list[Link]:
    """Links of a URDF or MJCF file from `base` on (None: from the file's root), parents first.

    Raises FileNotFoundError, ModuleNotFoundError (MJCF without MuJoCo) or ValueError with one sentence.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"Link file {path} is not there; give the arm's URDF or MJCF file.")
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"Link file {path} is larger than {_MAX_BYTES // 10**6} MB; give the arm's URDF or MJCF file.")
    text = path.read_text(errors="replace")
    if "<!ENTITY" in text:
        raise ValueError(f"Link file {path} declares XML entities, which no robot needs; remove them.")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ValueError(f"Link file {path} is no XML: {error}.") from error
    if root.tag == "robot":
        links = _read_urdf(root, path)
    elif root.tag == "mujoco":
        links = _read_mjcf(path)
    else:
        raise ValueError(f"Link file {path} is neither a URDF (<robot>) nor an MJCF (<mujoco>): it is a <{root.tag}>.")
    return _from(links, base, path)


def _read_urdf(robot: ET.Element, path: Path) -> list[Link]:
    """Links of a URDF; those of several roots are all there, each root without a parent."""
    joints = robot.findall("joint")
    by_name = {joint.get("name", ""): joint for joint in joints}
    children = {}
    for joint in joints:
        child, parent = joint.find("child"), joint.find("parent")
        if child is None or parent is None:
            raise ValueError(f"Joint '{joint.get('name')}' in {path} has no parent or no child link.")
        children[child.get("link", "")] = (parent.get("link", ""), joint)
    pending = [element.get("name", "") for element in robot.findall("link")]
    links: list[Link] = []
    placed: set[str] = set()
    while pending:
        ready = [name for name in pending if name not in children or children[name][0] in placed]
        if not ready:
            raise ValueError(f"Links {', '.join(pending)} in {path} hang on each other in a circle, or on no link.")
        for name in ready:
            links.append(_urdf_link(name, *children[name], by_name, path) if name in children else Link(name))
        placed.update(ready)
        pending = [name for name in pending if name not in placed]
    return links


def _urdf_link(name: str, parent: str, joint: ET.Element, joints: dict[str, ET.Element], path: Path) -> Link:
    kind = _URDF_KINDS.get(joint.get("type", ""))
    told = f"Joint '{joint.get('name')}' in {path}"
    if kind is None:
        raise ValueError(
            f"{told} is of type '{joint.get('type')}'; revolute, continuous, prismatic and fixed are known."
        )
    origin = joint.find("origin")
    pose = np.eye(4)
    if origin is not None:
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3, told)
        # Roll, pitch, yaw about fixed axes (URDF's specification).
        pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"), 3, told)).as_matrix()
    link = Link(name, parent, pose.tolist(), kind)
    if kind == "fixed":
        return link
    axis = joint.find("axis")
    link.axis = _unit(_numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0"), 3, told), told)
    link.joint, passed = joint.get("name", ""), []
    while (mimic := joint.find("mimic")) is not None:  # a joint may mimic one that mimics another
        passed.append(link.joint)
        link.joint = mimic.get("joint", "")
        if link.joint not in joints or link.joint in passed:
            reason = "itself" if link.joint in passed else f"'{link.joint}', which is not there"
            raise ValueError(f"{told} mimics {reason}.")
        link.shift += link.scale * _numbers(mimic.get("offset", "0"), 1, told)[0]
        link.scale *= _numbers(mimic.get("multiplier", "1"), 1, told)[0]
        joint = joints[link.joint]
    driver = _URDF_KINDS.get(joint.get("type", ""))
    if driver not in ("revolute", "prismatic"):
        raise ValueError(f"{told} mimics '{link.joint}', which is of type '{joint.get('type')}' and has no value.")
    link.joint_kind = "" if driver == kind else driver
    return link


def _read_mjcf(path: Path) -> list[Link]:
    """Bodies of an MJCF as MuJoCo itself reads them. A body of several joints gets a link per joint above it."""
    try:
        from ..sim.headless import mujoco
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Reading an MJCF file needs MuJoCo; install it with `pip install 'lerobot_policy_pi05_geometry[robot]'`, or "
            "give a URDF."
        ) from error
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {path}: {str(error).splitlines()[0].rstrip('.')}.") from error
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
    links = [Link(model.body(0).name)]
    for body in range(1, model.nbody):
        name, parent = body_name(model, body), body_name(model, int(model.body_parentid[body]))
        pose: np.ndarray = np.eye(4)
        pose[:3, 3] = model.body_pos[body]
        pose[:3, :3] = Rotation.from_quat(model.body_quat[body], scalar_first=True).as_matrix()
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for number in range(first, first + count):
            kind = kinds.get(int(model.jnt_type[number]))
            joint = model.joint(number).name or f"joint{number}"
            if kind is None:
                raise ValueError(f"Joint '{joint}' in {path} is a ball or free joint; an arm has hinges and slides.")
            there = np.eye(4)
            there[:3, 3] = model.jnt_pos[number]  # a hinge turns about this point of the body
            axis = _unit(model.jnt_axis[number].tolist(), f"Joint '{joint}' in {path}")
            shift = -float(model.qpos0[model.jnt_qposadr[number]])
            links.append(Link(f"{name}:{joint}", parent, (pose @ there).tolist(), kind, joint, axis, shift=shift))
            pose, parent = np.linalg.inv(there), f"{name}:{joint}"
        links.append(Link(name, parent, pose.tolist()))
    return links


def body_name(model, body: int) -> str:
    """The name of a body of MuJoCo, or its number where the file gives none."""
    return str(model.body(body).name or f"body{body}")


def _from(links: list[Link], base: str | None, path: Path) -> list[Link]:
    """The tree below `base`, which becomes the root."""
    names = [link.name for link in links]
    if base is None:
        roots = [link.name for link in links if not link.parent]
        if len(roots) != 1:
            raise ValueError(
                f"{path} has {len(roots)} root links ({', '.join(roots)}); say which is the base with --base."
            )
        base = roots[0]
    if base not in names:
        raise ValueError(f"{path} has no link '{base}'; it has {', '.join(names)}.")
    kept = [Link(base)]
    for link in links:
        if link.parent in [each.name for each in kept] and link.name != base:
            kept.append(link)
    return kept


def _numbers(text: str, count: int, told: str) -> list[float]:
    parts = text.split()
    try:
        numbers = [float(part) for part in parts]
    except ValueError as error:
        raise ValueError(f"{told} has '{text}' where {count} numbers belong.") from error
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{told} has '{text}' where {count} finite numbers belong.")
    return numbers


def _unit(axis: list[float], told: str) -> list[float]:
    length = math.dist(axis, (0, 0, 0))
    if length < 1e-9:
        raise ValueError(f"{told} has an axis of length 0.")
    return [value / length for value in axis]
