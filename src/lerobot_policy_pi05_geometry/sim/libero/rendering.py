"""LIBERO's cameras with metric depth and pose, all three of one moment.

robosuite samples its observations one or two simulation steps before `step` returns, while the wrist moves on: a pose
read after `step` is 0.3 to 0.4 mm off. So one observable of robosuite's takes the picture, the depth and the pose together.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...geometry.camera import CameraCalibration
from ..headless import mujoco
from .cameras import intrinsics, opencv_pose

# Our name -> MuJoCo's. No name may contain "image": LeRobot takes such keys for images when it records.
CAMERAS = {"front": "agentview", "wrist": "robot0_eye_in_hand"}
RENDERINGS = ("full", "fast")
_FLAGS = mujoco.mjtRndFlag
_SLOW = (_FLAGS.mjRND_SHADOW, _FLAGS.mjRND_REFLECTION)


@dataclass(frozen=True)
class Frame:
    """What one camera saw. pixels: (S, S, 3) uint8, upright, not mirrored. depth: (S, S) float32 metres along the
    optical axis. extrinsics: (4, 4) float64, base_T_camera, OpenCV axes, metres."""

    pixels: np.ndarray
    depth: np.ndarray
    extrinsics: np.ndarray


class CameraRig:
    """Renders LIBERO's cameras; `depth=False` leaves depth out (zeros), for speed.

    rendering: `full` draws RGB as LeRobot's LIBERO does, with shadows and multisampling; `fast` without, some three times
    as fast on a CPU. Depth never has multisampling: an average of two surfaces is on neither.
    """

    def __init__(self, model: Any, size: int, rendering: str = "full", depth: bool = True) -> None:
        if rendering not in RENDERINGS:
            raise ValueError(f"There is no rendering '{rendering}'; choose one of: {', '.join(RENDERINGS)}.")
        self.size, self._rendering, self._with_depth = size, rendering, depth
        self.model = model
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, size)
        model.vis.global_.offheight = max(model.vis.global_.offheight, size)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[0] = 0  # collision geometry is not seen
        samples = model.vis.quality.offsamples
        model.vis.quality.offsamples = 0
        self._plain = mujoco.Renderer(model, size, size)
        self._colour = self._plain
        if rendering == "full":
            model.vis.quality.offsamples = samples
            self._colour = mujoco.Renderer(model, size, size)
        self.calibration: dict[str, CameraCalibration] = {
            name: intrinsics(float(model.cam_fovy[self._id(name)]), size) for name in CAMERAS
        }

    def _id(self, name: str) -> int:
        return int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, CAMERAS[name]))

    def take(self, data: Any, name: str) -> Frame:
        """What a camera sees now."""
        camera = self._id(name)
        self._colour.update_scene(data, camera, self._options)
        if self._rendering == "fast":
            for flag in _SLOW:
                self._colour.scene.flags[flag] = 0
        pixels = self._colour.render()
        depth = np.zeros(pixels.shape[:2], np.float32)
        if self._with_depth:
            if self._plain is not self._colour:
                self._plain.update_scene(data, camera, self._options)
            self._plain.enable_depth_rendering()
            depth = self._plain.render()
            self._plain.disable_depth_rendering()
        world_t_camera = opencv_pose(data.cam_xpos[camera], data.cam_xmat[camera])
        return Frame(pixels, depth, np.linalg.inv(base_pose(data)) @ world_t_camera)

    def close(self) -> None:
        for renderer in {id(r): r for r in (self._plain, self._colour)}.values():
            renderer.close()


def base_pose(data: Any) -> np.ndarray:
    """Pose of the Panda's base in the world, (4, 4)."""
    base, pose = data.body("robot0_base"), np.eye(4)
    pose[:3, :3], pose[:3, 3] = base.xmat.reshape(3, 3), base.xpos
    return pose


def ray_errors(rig: CameraRig, data: Any, name: str, frame: Frame, rays: int = 64, seed: int = 0) -> np.ndarray:
    """Distance between a frame's depth and what rays through its pixels meet, (N,) metres along the optical axis.

    MuJoCo's ray casting knows nothing of rendering, so this checks depth, intrinsics and extrinsics at once. The frame
    must have been taken of `data` as it is.
    """
    fx, fy, cx, cy = rig.calibration[name].intrinsics
    pixels = np.random.default_rng(seed).integers(1, rig.size - 1, (rays, 2))
    pose = base_pose(data) @ frame.extrinsics
    groups = np.array([0, 1, 1, 0, 0, 0], dtype=np.uint8)  # what is drawn: no collision geometry
    errors, geom = [], np.zeros(1, dtype=np.int32)
    for v, u in pixels:
        ray = np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
        direction = pose[:3, :3] @ (ray / np.linalg.norm(ray))
        length = mujoco.mj_ray(rig.model, data, pose[:3, 3], direction, groups, 1, -1, geom)
        if length > 0:
            errors.append(length / np.linalg.norm(ray) - frame.depth[v, u])
    return np.abs(errors)
