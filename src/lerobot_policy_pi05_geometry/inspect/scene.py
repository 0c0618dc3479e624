"""What a calibration makes of a frame: the points of all depth cameras in the base frame, with the arm's links in them."""

from collections.abc import Mapping
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from ..geometry.calibration import Calibration, Rig
from ..geometry.depth import to_metres
from ..geometry.keys import RAW_STATE, RIG, extrinsics_key, find_depth_key
from ..geometry.kinematics import ForwardKinematics
from ..geometry.placed_camera import PlacedCamera
from ..geometry.point_map import as_pose, transform, unproject

matplotlib.use("Agg")

from matplotlib.figure import Figure

_COLOURS = ("#4263eb", "#e8590c", "#0b7285", "#ae3ec9", "#f59f00")
_SHOWN = 6000  # points a camera
_AXIS = 0.08  # metres of its optical axis that are drawn of a camera


class Scene(NamedTuple):
    """All in metres in the base frame. points: per depth camera (N, 3). bones: per arm (M, 2, 3), from each link's origin to its
    parent's. cameras: `base_T_camera` (4, 4) of every camera whose pose is known, with depth or without.
    """

    points: dict[str, np.ndarray]
    bones: dict[str, np.ndarray]
    cameras: dict[str, np.ndarray]


def scene_of(
    batch: Mapping[str, Tensor],
    calibration: Rig,
    unit: str = "mm",
    max_depth: float = 2.0,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    depth_keys: Mapping[str, str] | None = None,
) -> Scene:
    """The scene of a raw batch of one (state not normalised), for a calibration of one rig or of several.

    unit, max_depth, bounds (by camera): as in `depth.to_metres`. depth_keys: see `keys.find_depth_key`.
    """
    rig = _rig_of(batch, calibration)
    state = batch.get(RAW_STATE, batch.get(OBS_STATE))
    batch = dict(batch) if state is None else {**batch, RAW_STATE: state}
    points, cameras = {}, {}
    for name in rig.cameras:
        key = find_depth_key(name, batch, depth_keys or {})
        raw = None if key is None else batch[key][:1].cpu()
        if raw is not None and raw.shape[1] != 1:
            raw = raw.permute(0, 3, 1, 2)
        width, height = rig.cameras[name].as_recorded().size
        placed = PlacedCamera(name, {0: rig}, (height, width) if raw is None else (raw.shape[-2], raw.shape[-1]))
        pose = _pose_of(placed, batch)
        if pose is None:
            continue
        cameras[name] = pose.numpy()
        if raw is None or key is None:
            continue
        size = (raw.shape[-2], raw.shape[-1])
        factor = placed.depth_factor(None, raw.device)
        depth, valid = to_metres(raw, key, unit, size, max_depth, factor, (bounds or {}).get(name, (0.0, np.inf)))
        seen = transform(pose, unproject(depth, placed.intrinsics(None, raw.device)))
        points[name] = seen[0].flatten(1).mT[valid.flatten()].numpy()
    bones = {}
    for name, arm in rig.arms.items():
        if state is None:
            continue
        kinematics = ForwardKinematics(arm, [link.name for link in arm.links])
        places = dict(zip(kinematics.links, kinematics(state[:1].cpu().float())[0, :, :3, 3].numpy(), strict=True))
        bones[name] = np.array([[places[link.parent], places[link.name]] for link in arm.links if link.parent])
    return Scene(points, bones, cameras)


def _rig_of(batch: Mapping[str, Tensor], calibration: Rig) -> Rig:
    """The rig that a frame is of. Raises ValueError for a frame that does not say it, where it has to."""
    if not isinstance(calibration, Calibration) or not calibration.rigs:
        return calibration
    number = str(int(batch[RIG].flatten()[0])) if RIG in batch else "not given"
    if number not in calibration.rigs:
        raise ValueError(
            f"The frame's {RIG} is {number}, but the calibration has the rigs {', '.join(calibration.rigs)}."
        )
    return calibration.rigs[number]


def _pose_of(placed: PlacedCamera, batch: Mapping[str, Tensor]) -> Tensor | None:
    """`base_T_camera` (4, 4) that comes with the frame, or by the calibration; None if neither tells it."""
    key = extrinsics_key(placed.name)
    if key in batch:
        return placed.frame_poses(as_pose(batch[key][:1].cpu().float(), key), None)[0]
    if not placed.placed or (placed.on_arm and RAW_STATE not in batch):
        return None
    state = {RAW_STATE: batch[RAW_STATE][:1].cpu()} if placed.on_arm else {}
    return placed.poses(state, None, torch.device("cpu")).reshape(4, 4)


def scene_figure(scene: Scene) -> Figure:
    """The scene from above and from the side. Points of all cameras must lie on each other, and the arm's links inside them.

    Cameras are squares with a piece of their optical axis.
    """
    figure = Figure(figsize=(11, 5), layout="constrained")
    views = (("from above", 0, 1, "x", "y"), ("from the side", 1, 2, "y", "z"))
    for axes, (title, across, up, x_name, y_name) in zip(figure.subplots(1, 2), views, strict=True):
        for (name, points), colour in zip(scene.points.items(), _COLOURS * 4, strict=False):
            some = points[:: max(1, len(points) // _SHOWN)]
            size = float(np.clip(2000 / max(1, len(some)), 0.6, 4.0))
            axes.scatter(some[:, across], some[:, up], s=size, color=colour, alpha=0.5, label=name, linewidths=0)
        for pose in scene.cameras.values():
            ahead = np.stack([pose[:3, 3], pose[:3, 3] + _AXIS * pose[:3, 2]])
            axes.plot(ahead[:, across], ahead[:, up], color="#868e96", linewidth=1.5)
            axes.plot(*pose[[across, up], 3], color="#868e96", marker="s", markersize=5)
        for name, bones in scene.bones.items():
            for bone in bones:
                axes.plot(bone[:, across], bone[:, up], color="#22303c", linewidth=2, marker="o", markersize=3)
            axes.plot([], [], color="#22303c", linewidth=2, label=name)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{x_name} (m, base frame)")
        axes.set_ylabel(f"{y_name} (m)")
        axes.set_title(title)
        if scene.points or scene.bones:
            axes.legend(loc="upper right", markerscale=4, frameon=False)
    return figure


def log_to_rerun(scene: Scene, path: str) -> None:
    """Write the scene as a file for the rerun viewer. Raises ModuleNotFoundError without rerun."""
    try:
        import rerun as rr
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Writing a rerun file needs rerun; install it with `pip install 'lerobot_policy_pi05_geometry[robot]'`, or leave "
            "--rerun out."
        ) from error
    recording = rr.RecordingStream("pi05_geometry_scene")
    recording.save(path)
    for name, points in scene.points.items():
        recording.log(f"base/{name}", rr.Points3D(points))
    for name, bones in scene.bones.items():
        recording.log(f"base/{name}", rr.LineStrips3D(bones, radii=0.004))
    for name, pose in scene.cameras.items():
        recording.log(f"base/cameras/{name}", rr.Arrows3D(origins=[pose[:3, 3]], vectors=[_AXIS * pose[:3, 2]]))
    recording.flush()
