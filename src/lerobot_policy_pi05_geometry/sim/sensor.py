"""Simulated faults of a depth sensor and of its calibration.

They change the depth and the extrinsics of an observation only: not the scene, the RGB image or the expert.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class DepthSensor:
    """A depth camera and the error of its calibration.

    on: False measures nothing at any pixel. noise: noise and holes of a structured-light camera (`measure`).
    rotation, translation: size of the error in the reported extrinsics, degrees and metres; its direction is drawn
    once per episode, since a wrong calibration is constant.
    """

    on: bool = True
    noise: bool = False
    rotation: float = 0.0
    translation: float = 0.0

    def measure(self, depth: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """True depth (H, W) in metres -> measured depth, 0 where not measured.

        Axial noise has the standard deviation 1.2 mm + 1.9 mm (z - 0.4 m)^2, lateral noise 0.8 pixels, both after
        Nguyen, Izadi and Lovell (2012) for the Kinect. Half of the pixels at depth edges are lost (the
        projector's shadow), and blobs that cover some 5 % of the image (reflecting or absorbing surfaces).
        """
        if not self.on:
            return np.zeros_like(depth)
        if not self.noise:
            return depth
        rows, columns = np.indices(depth.shape)
        lateral = np.rint(generator.normal(0.0, 0.8, (2, *depth.shape))).astype(int)
        rows = (rows + lateral[0]).clip(0, depth.shape[0] - 1)
        columns = (columns + lateral[1]).clip(0, depth.shape[1] - 1)
        measured = depth[rows, columns] + generator.normal(0.0, 0.0012 + 0.0019 * (depth - 0.4) ** 2)
        edge = maximum_filter(depth, 3) - minimum_filter(depth, 3) > 0.03
        blobs = gaussian_filter(generator.normal(size=depth.shape), depth.shape[0] / 16, mode="wrap")
        lost = (edge & (generator.random(depth.shape) < 0.5)) | (blobs > np.quantile(blobs, 0.95))
        return np.where(lost, 0.0, measured)

    def draw_pose_error(self, generator: np.random.Generator) -> np.ndarray:
        """Calibration error of an episode, (4, 4): `base_T_camera` is multiplied by it from the right."""
        error = np.eye(4)
        axis, direction = (vector / np.linalg.norm(vector) for vector in generator.normal(size=(2, 3)))
        error[:3, :3] = Rotation.from_rotvec(np.radians(self.rotation) * axis).as_matrix()
        error[:3, 3] = self.translation * direction
        return error


SENSORS = {
    "ideal": DepthSensor(),
    "noisy": DepthSensor(noise=True),
    "off": DepthSensor(on=False),
    "calibration-1": DepthSensor(rotation=1.0, translation=0.01),
    "calibration-2": DepthSensor(rotation=2.0, translation=0.02),
    "calibration-5": DepthSensor(rotation=5.0, translation=0.05),
}
