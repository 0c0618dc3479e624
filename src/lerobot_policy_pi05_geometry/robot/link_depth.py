"""Measured depth against the arm itself: how far a link is follows from the joints, the camera's pose and the link file's shapes.

This is the only check of a depth scale that needs no board and nothing but a recording. Shapes are hit by rays (MuJoCo), one
for every pixel that is looked at; nothing is rendered.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_STATE

from ..geometry.calibration import Rig
from ..geometry.dataset_calibration import check_state_names, state_names
from ..geometry.dataset_depth import codec_bounds
from ..geometry.depth import to_metres
from ..geometry.keys import RAW_STATE, find_depth_key, find_depth_keys
from ..geometry.kinematics import Arm, ForwardKinematics
from ..geometry.placed_camera import PlacedCamera
from .dataset_views import spread_out, still_frames
from .joint_offsets import levers
from .link_files import body_name

MAX_SCALE_ERROR = 0.10
MIN_PIXELS = 100  # with a link in them, over all frames
_FRAMES = 30
_ACROSS = 80  # columns and rows of rays, at most
_NEAREST = 0.05  # metres: what is nearer, the camera's own mount say, no depth camera measures
_FARTHEST = 100.0  # metres: depth whose scale is wrong is ten times too far
_SAME_PLACE = 1e-4  # metres, and entries of a rotation
_SAME_FILE = "give the link file that `pi05-geometry calibrate arm` read"


class LinkDepth(NamedTuple):
    """ratio: measured depth over what it should be, the median of `pixels` pixels of `frames` frames."""

    ratio: float
    pixels: int
    frames: int


class ArmShape:
    """Shapes of an arm's links. path: of its URDF or MJCF file, with its meshes beside it.

    Raises ValueError where MuJoCo cannot read the file, or the file's links stand otherwise to each other than the arm's.
    """

    def __init__(self, path: Path, arm: Arm) -> None:
        self._mujoco = _mujoco()
        try:
            self.model = self._mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise ValueError(
                f"MuJoCo cannot read {path}: {str(error).splitlines()[0].rstrip('.')}; the file's meshes are needed, too."
            ) from error
        self.data = self._mujoco.MjData(self.model)
        self.arm = arm
        moved = [link.name for link in arm.links if len(arm.chain(link.name)) > 1]
        self.kinematics = ForwardKinematics(arm, moved)
        bodies = {body_name(self.model, i): i for i in range(self.model.nbody)}
        # A link whose place the state does not tell is none to measure.
        placed = [name for name in moved if not ForwardKinematics(arm, [name]).unknown_joints]
        self._bodies = [bodies[name] for name in placed if name in bodies and bodies[name] > 0]
        self._joints = self._addresses(bodies, path)
        self._world_T_base = self._find_base(bodies, path)
        if not np.isin(self.model.geom_bodyid, self._bodies).any():
            raise ValueError(
                f"{path} has no shape on any link that the state moves; give a link file with meshes or geoms."
            )

    def _addresses(self, bodies: dict[str, int], path: Path) -> list[tuple[int, int, float, float]]:
        """Per joint of MuJoCo that the state moves: its place in qpos, that of its value, scale and shift."""
        found, seen = [], dict.fromkeys(bodies, 0)
        for link in self.arm.links:
            if not link.joint:
                continue
            # `read_links` names the links of a body's several joints BODY:JOINT.
            body = link.name if link.name in bodies else link.name.partition(":")[0]
            if seen.get(body, 0) >= (self.model.body_jntnum[bodies[body]] if body in bodies else 0):
                raise ValueError(f"{path} has no link '{body}' on joint '{link.joint}', as the arm has; {_SAME_FILE}.")
            joint = int(self.model.body_jntadr[bodies[body]]) + seen[body]
            seen[body] += 1
            address = int(self.model.jnt_qposadr[joint])
            start = float(self.model.qpos0[address])
            found.append((address, self.kinematics.joints.index(link.joint), link.scale, link.shift + start))
        return found

    def _find_base(self, bodies: dict[str, int], path: Path) -> np.ndarray:
        """`world_T_base` (4, 4), from where the moved links stand.

        The base itself may be no body of MuJoCo's: it joins a URDF's links that no joint moves with its world.
        """
        values = np.full(len(self.kinematics.joints), 0.3)  # any but 0, where turned axes would not show
        self._move(values)
        poses = self.kinematics.poses(torch.from_numpy(values)[None])[0].numpy()
        there = [(name, pose) for name, pose in zip(self.kinematics.links, poses, strict=True) if name in bodies]
        bases = [self._pose(bodies[name]) @ np.linalg.inv(pose) for name, pose in there]
        for (name, _), base in zip(there, bases, strict=True):
            if not np.allclose(base, bases[0], atol=_SAME_PLACE):
                raise ValueError(f"Link '{name}' of {path} stands elsewhere than the arm's '{name}'; {_SAME_FILE}.")
        return bases[0] if bases else np.eye(4)

    def _move(self, values: np.ndarray) -> None:
        for address, number, scale, shift in self._joints:
            self.data.qpos[address] = scale * values[number] + shift
        self._mujoco.mj_kinematics(self.model, self.data)

    def _pose(self, body: int) -> np.ndarray:
        """`world_T_body` (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return pose

    def depth(self, values: np.ndarray, base_T_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:  # noqa: N803
        """How far the arm is along the optical axis, (N,) metres; NaN where a ray hits none of its links first.

        values: of `kinematics.joints`, radians or metres. rays: (N, 3) in the camera's frame, z = 1.
        """
        self._move(values)
        camera = self._world_T_base @ base_T_camera
        lengths = np.linalg.norm(rays, axis=1)
        directions = (rays / lengths[:, None]) @ camera[:3, :3].T
        # One by one, at 4 microseconds each: mj_multiRay of MuJoCo 3.3 misses shapes near the rays' origin.
        geoms, distances, geom = np.zeros(len(rays), np.int32), np.zeros(len(rays)), np.zeros(1, np.int32)
        origin = camera[:3, 3].copy()
        for number, direction in enumerate(directions):
            distances[number] = self._mujoco.mj_ray(self.model, self.data, origin, direction, None, 1, -1, geom)
            geoms[number] = geom[0]
        of_arm = (geoms >= 0) & np.isin(self.model.geom_bodyid[geoms.clip(0)], self._bodies)
        depth: np.ndarray = np.where(of_arm, distances / lengths, np.nan)
        return depth


def check_link_depth(dataset: LeRobotDataset, rig: Rig, camera: str, arm_name: str, model: Path) -> LinkDepth:
    """Compare a camera's depth with the arm in it. model: the arm's link file.

    Raises ValueError where it is more than 10 % off, or where too little of the arm is in view to tell.
    """
    if camera not in rig.cameras or arm_name not in rig.arms:
        known = ", ".join([*rig.cameras, *rig.arms]) or "nothing"
        raise ValueError(f"The calibration has no camera '{camera}' or no arm '{arm_name}'; it has {known}.")
    features = dataset.meta.features
    check_state_names(rig, features)
    if (names := state_names(features)) is not None:
        rig.arms[arm_name].check_state_names(arm_name, names)
    depth_keys = find_depth_keys(features, {})
    key = find_depth_key(camera, features, depth_keys)
    if key is None:
        raise ValueError(f"The dataset has no depth of camera '{camera}'; record it with use_depth=true.")
    bounds = codec_bounds(features, [camera], depth_keys).get(camera, (0.0, np.inf))
    height, width = (side for side in features[key]["shape"] if side != 1)
    placed = PlacedCamera(camera, {0: rig}, (height, width))
    placed.check_view()
    if not placed.placed:
        raise ValueError(f"Camera '{camera}' has no pose; find it with `pi05-geometry calibrate hand-eye`.")
    shape = ArmShape(model, rig.arms[arm_name])
    cpu = torch.device("cpu")
    fx, fy, cx, cy = placed.intrinsics(None, cpu).tolist()
    v, u = np.meshgrid(_every(height), _every(width), indexing="ij")
    rays = np.stack([(u.ravel() - cx) / fx, (v.ravel() - cy) / fy, np.ones(u.size)], axis=1)
    ratios: list[np.ndarray] = []
    frames = _frames(dataset, shape.kinematics)
    for frame in frames:
        item = dataset[frame]
        state = item[OBS_STATE][None].double()
        pose = placed.poses({RAW_STATE: state}, None, cpu).reshape(4, 4).double().numpy()
        raw = item[key].float().reshape(1, 1, height, width)
        factor = placed.depth_factor(None, cpu)
        depth, valid = to_metres(raw, key, "mm", (height, width), _FARTHEST, factor, (bounds[0], bounds[1]))
        expected = shape.depth(shape.kinematics.values(state)[0].numpy(), pose, rays)
        measured = depth[0, 0].numpy()[v, u].ravel()
        there = valid[0, 0].numpy()[v, u].ravel() & (expected > _NEAREST)  # comparisons with NaN are False
        ratios.append(measured[there] / expected[there])
    found = np.concatenate(ratios)
    if len(found) < MIN_PIXELS:
        raise ValueError(
            f"Camera '{camera}' measures the arm in {len(found)} of the pixels that were looked at in {len(frames)} frames, but "
            f"{MIN_PIXELS} are needed; record the arm in view of the camera, some 20 cm away."
        )
    result = LinkDepth(float(np.median(found)), len(found), len(frames))
    if abs(result.ratio - 1) > MAX_SCALE_ERROR:
        raise ValueError(
            f"Depth of camera '{camera}' is {result.ratio:.2f} times what the arm's links in its view say; read its "
            "depth_scale with `pi05-geometry calibrate camera` (a D405 counts in 0.1 mm), and its pose with `pi05-geometry "
            "calibrate hand-eye`."
        )
    return result


def _every(count: int) -> np.ndarray:
    return np.arange(0, count, max(1, count // _ACROSS))


def _frames(dataset: LeRobotDataset, kinematics: ForwardKinematics) -> list[int]:
    """Frames in which the arm stands in different poses, and stands still if it ever does."""
    rows = dataset.hf_dataset.select_columns([OBS_STATE, "episode_index"])[:]
    states = torch.stack([torch.as_tensor(state) for state in rows[OBS_STATE]]).double()
    values = kinematics.values(states).numpy() / levers(kinematics)
    still = still_frames(values, np.array([int(number) for number in rows["episode_index"]]))
    return spread_out(values, still if len(still) >= _FRAMES else np.arange(len(values)), _FRAMES)


def _mujoco() -> Any:
    try:
        from ..sim.headless import mujoco
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Rays against the arm's links need MuJoCo; install it with `pip install 'lerobot_policy_pi05_geometry[robot]'`."
        ) from error
    return mujoco
