"""What a calibration makes of a frame: the points of all depth cameras in the base frame, with the arm's links in them."""

import logging
from collections.abc import Mapping
from typing import NamedTuple

import matplotlib
import numpy as np
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from ..geometry.calibration import Rig
from ..geometry.depth import to_metres
from ..geometry.keys import RAW_STATE, depth_key
from ..geometry.kinematics import ForwardKinematics
from ..geometry.placed_camera import PlacedCamera
from ..geometry.point_map import transform, unproject

matplotlib.use("Agg")

from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

_COLOURS = ("#4263eb", "#e8590c", "#0b7285", "#ae3ec9", "#f59f00")
_SHOWN = 6000  # points a camera


class Scene(NamedTuple):
    """points: per camera (N, 3) metres in the base frame. bones: per arm (M, 2, 3), from each link's origin to its parent's."""

    points: dict[str, np.ndarray]
    bones: dict[str, np.ndarray]


def scene_of(
    batch: Mapping[str, Tensor],
    rig: Rig,
    unit: str = "mm",
    max_depth: float = 2.0,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> Scene:
    """The scene of a raw batch of one (state not normalised). Cameras without depth or pose in it are left out."""
    state = batch.get(RAW_STATE, batch.get(OBS_STATE))
    batch = dict(batch) if state is None else {**batch, RAW_STATE: state}
    points = {}
    for name, camera in rig.cameras.items():
        key = depth_key(name)
        if key not in batch or (camera.extrinsics is None and camera.mount is None):
            continue
        raw = batch[key][:1]
        raw = raw if raw.shape[1] == 1 else raw.permute(0, 3, 1, 2)
        size = (raw.shape[-2], raw.shape[-1])
        placed = PlacedCamera(name, {0: rig}, size)
        factor = placed.depth_factor(None, raw.device)
        depth, valid = to_metres(raw, key, unit, size, max_depth, factor, (bounds or {}).get(name, (0.0, np.inf)))
        seen = unproject(depth, placed.intrinsics(None, raw.device))
        seen = transform(placed.poses(batch, None, raw.device), seen)
        points[name] = seen[0].flatten(1).mT[valid.flatten()].numpy()
    bones = {}
    for name, arm in rig.arms.items():
        if state is None:
            continue
        kinematics = ForwardKinematics(arm, [link.name for link in arm.links])
        places = dict(zip(kinematics.links, kinematics(state[:1].float())[0, :, :3, 3].numpy(), strict=True))
        bones[name] = np.array([[places[link.parent], places[link.name]] for link in arm.links if link.parent])
    return Scene(points, bones)


def scene_figure(scene: Scene) -> Figure:
    """The scene from above and from the side. Points of all cameras must lie on each other, and the arm's links inside them."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    views = (("from above", 0, 1, "x", "y"), ("from the side", 1, 2, "y", "z"))
    for axes, (title, across, up, x_name, y_name) in zip(figure.subplots(1, 2), views, strict=True):
        for (name, points), colour in zip(scene.points.items(), _COLOURS * 4, strict=False):
            some = points[:: max(1, len(points) // _SHOWN)]
            axes.scatter(some[:, across], some[:, up], s=0.6, color=colour, alpha=0.5, label=name, linewidths=0)
        for name, bones in scene.bones.items():
            for bone in bones:
                axes.plot(bone[:, across], bone[:, up], color="#22303c", linewidth=2, marker="o", markersize=3)
            axes.plot([], [], color="#22303c", marker="o", label=name)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{x_name} (m, base frame)")
        axes.set_ylabel(f"{y_name} (m)")
        axes.set_title(title)
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
