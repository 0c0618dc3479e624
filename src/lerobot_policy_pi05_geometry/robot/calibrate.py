"""From a recording and a calibration file to a better calibration file."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_IMAGES

from ..dataset_folder import require_dataset
from ..geometry.calibration import Calibration
from ..geometry.camera import CameraCalibration, Mount, pose_of_sensor
from ..geometry.dataset_calibration import state_names
from ..geometry.depth import LEROBOT_COUNT
from ..geometry.keys import depth_key
from ..geometry.kinematics import Arm, ForwardKinematics, Link, StateJoint, joint_kinds
from .board import Board, board_pose
from .dataset_views import find_views, image_size
from .hand_eye import HandEye, solve_hand_eye
from .hand_eye_problem import View

MAX_SCALE_ERROR = 0.10  # of the depth of a board whose size is known


class ImageStream(NamedTuple):
    """The stream whose images show the board. stream_T_depth: (4, 4), depth camera in it."""

    intrinsics: list[float]
    distortion: list[float]
    stream_T_depth: np.ndarray  # noqa: N815


def make_arm(
    links: list[Link],
    names: list[str],
    given: dict[str, str] | None = None,
    unit: str = "degrees",
    units: dict[str, str] | None = None,
) -> Arm:
    """An arm whose joints are state entries of the same name, `<joint>.pos` or `<joint>`.

    names: of the dataset's state. given: joint -> state entry, where the names differ. A joint without an entry stays at 0. unit:
    of all joints; a prismatic one has metres where it is an angle's. units: joint -> its unit, where that is another one.
    """
    given, units, kinds = given or {}, units or {}, joint_kinds(links)
    missing = sorted((set(given) | set(units)) - set(kinds))
    if missing:
        raise ValueError(f"The link file has no joint {', '.join(missing)}; it has {', '.join(kinds)}.")
    unknown = sorted(set(given.values()) - set(names))
    if unknown:
        raise ValueError(f"The state has no entry {', '.join(unknown)}; it has {', '.join(names)}.")
    joints: list[StateJoint] = []
    for joint, kind in kinds.items():
        entry = given.get(joint) or next((n for n in (f"{joint}.pos", joint) if n in names), None)
        if entry is not None:
            taken = next((other.joint for other in joints if other.state == entry), None)
            if taken is not None:
                raise ValueError(
                    f"State entry '{entry}' is given to two joints, {taken} and {joint}; say which it is with --joint."
                )
            metres = kind == "prismatic" and unit in ("degrees", "radians")
            joints.append(StateJoint(joint, entry, names.index(entry), units.get(joint, "metres" if metres else unit)))
    without = sorted(set(units) - {joint.joint for joint in joints})
    if joints and without:
        raise ValueError(f"--unit names {', '.join(without)}, for which the state has no entry; say it with --joint.")
    if not joints:
        raise ValueError(
            f"No joint of the link file has the name of a state entry ({', '.join(names)}); say which is which with "
            f"--joint NAME=ENTRY."
        )
    arm = Arm(links, joints)
    arm.check("arm")
    return arm


def keep_offsets(made: Arm, before: Arm | None) -> list[str]:
    """Give an arm the joint offsets of the one before it, where link file, sign and state entry of a joint are the same.

    Returns the joints whose offset is not 0.
    """
    if before is None or made.links != before.links:
        return []
    known = {joint.joint: joint for joint in before.joints}
    made.joints = [
        replace(joint, offset=known[joint.joint].offset)
        if joint.joint in known and replace(known[joint.joint], offset=joint.offset) == joint
        else joint
        for joint in made.joints
    ]
    return [joint.joint for joint in made.joints if joint.offset]


def named_state(dataset: LeRobotDataset) -> list[str]:
    """Names of the state's entries. Raises ValueError if the dataset does not say them."""
    names = state_names(dataset.meta.features)
    if names is None:
        raise ValueError("The dataset does not name the entries of its state; record it with lerobot-record.")
    return names


def calibrate_hand_eye(
    root: Path,
    repo_id: str,
    calibration: Calibration,
    camera: str,
    arm_name: str,
    link: str,
    board: Board,
    wrist: bool,
    keep_offsets: bool = False,
) -> tuple[Calibration, HandEye]:
    """A calibration with this camera's pose and the arm's joint offsets, and how good they are.

    link: that carries the camera (wrist), or the board (fixed camera). keep_offsets: the arm keeps the offsets that it has.
    Raises ValueError with one sentence.
    """
    if camera not in calibration.cameras:
        raise ValueError(
            f"The calibration has no camera '{camera}'; read it first with `pi05-geometry calibrate camera`."
        )
    if arm_name not in calibration.arms:
        raise ValueError(f"The calibration has no arm '{arm_name}'; write it first with `pi05-geometry calibrate arm`.")
    arm, of_camera = calibration.arms[arm_name], calibration.cameras[camera]
    dataset = LeRobotDataset(repo_id, root=require_dataset(root))
    arm.check_state_names(arm_name, named_state(dataset))
    kinematics = ForwardKinematics(arm, [link])
    image_key = f"{OBS_IMAGES}.{camera}"
    views = find_views(dataset, image_key, kinematics, board)
    stream = image_stream(of_camera, camera, image_size(dataset.meta.features[image_key]))
    check_board_depth(dataset, camera, of_camera, stream, views, board)
    found = solve_hand_eye(
        kinematics, views, board, stream.intrinsics, stream.distortion, wrist, keep_offsets=keep_offsets
    )
    pose = pose_of_sensor(found.camera @ stream.stream_T_depth, of_camera.rotation)
    placed = (
        replace(of_camera, extrinsics=None, mount=Mount(arm_name, link, pose.tolist()))
        if wrist
        else replace(of_camera, extrinsics=pose.tolist(), mount=None)
    )
    joints = [replace(j, offset=j.offset + found.offsets.get(j.joint, 0.0)) for j in arm.joints]
    changed = Calibration(
        calibration.cameras | {camera: placed}, calibration.arms | {arm_name: replace(arm, joints=joints)}
    )
    changed.check()
    return changed, found


def cameras_on_arm(calibration: Calibration, arm: str, other_than: str) -> list[str]:
    """Cameras that this arm carries: their poses follow from its joints' offsets."""
    carried = [name for name, camera in calibration.cameras.items() if camera.mount and camera.mount.arm == arm]
    return [name for name in carried if name != other_than]


def image_stream(camera: CameraCalibration, name: str, size: tuple[int, int] | None) -> ImageStream:
    """The stream of a camera's colour images as they are recorded. size: (height, width) of the dataset's images."""
    recorded = camera.as_recorded()
    if recorded.color is None and camera.stream == "depth":
        raise ValueError(
            f"The calibration of camera '{name}' does not say where its colour stream stands, in whose images the "
            f"board is; read both "
            "streams with `pi05-geometry calibrate camera`, or set its stream to 'color' if depth is aligned to colour."
        )
    if recorded.color is None:
        intrinsics, distortion, known, apart = recorded.intrinsics, [0.0] * 5, recorded.size, np.eye(4)
    else:
        color = recorded.color
        intrinsics, distortion, known = color.intrinsics, color.distortion, color.size
        apart = np.linalg.inv(np.array(color.depth_T_color))
    if size is not None and [size[1], size[0]] != known:
        raise ValueError(
            f"Images of camera '{name}' are {size[1]} x {size[0]} pixels, but its calibration holds for {known[0]} x "
            f"{known[1]}; read it again with the size that you record with."
        )
    return ImageStream(intrinsics, distortion, apart)


def check_board_depth(
    dataset: LeRobotDataset, name: str, camera: CameraCalibration, stream: ImageStream, views: list[View], board: Board
) -> None:
    """Raise ValueError if the depth of the board's corners is more than 10 % off what their size in the image says."""
    key = depth_key(name)
    if key not in dataset.meta.features or not views:
        return
    recorded = camera.as_recorded()
    factor = 1.0 if camera.depth_scale is None else camera.depth_scale / LEROBOT_COUNT
    ratios: list[float] = []
    for view in views[:: max(1, len(views) // 8)]:
        depth = dataset[view.frame][key].float().squeeze() * 1e-3 * factor  # LeRobot gives millimetres
        corners = np.c_[board.corners[view.seen.ids], np.ones(len(view.seen.ids))]
        camera_T_board = board_pose(board, view.seen, stream.intrinsics, stream.distortion)
        points = corners @ (np.linalg.inv(stream.stream_T_depth) @ camera_T_board).T
        fx, fy, cx, cy = recorded.scaled_intrinsics(*depth.shape)
        u = np.rint(points[:, 0] / points[:, 2] * fx + cx).astype(int)
        v = np.rint(points[:, 1] / points[:, 2] * fy + cy).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
        measured = depth[torch.from_numpy(v[inside]), torch.from_numpy(u[inside])].numpy()
        there = measured > 0.011  # 0, or what LeRobot's codec makes of it
        ratios.extend((measured[there] / points[inside][there, 2]).tolist())
    if len(ratios) >= 10 and abs(float(np.median(ratios)) - 1) > MAX_SCALE_ERROR:
        raise ValueError(
            f"Depth of camera '{name}' is {float(np.median(ratios)):.2f} times what the board's size says; read its "
            f"depth_scale with "
            "`pi05-geometry calibrate camera`, and measure the board's print."
        )
