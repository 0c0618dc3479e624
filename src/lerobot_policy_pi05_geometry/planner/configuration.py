"""Completes a configuration as a dataset would."""

from dataclasses import replace

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry import CameraCalibration
from ..geometry.keys import DEPTH_SUFFIX

# Memory does not depend on where a camera stands.
_POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def complete(
    config: PI05GeometryConfig,
    cameras: int = 2,
    depth_cameras: int = 1,
    image_size: tuple[int, int] = (480, 640),
    state_dim: int = 14,
    action_dim: int = 14,
) -> PI05GeometryConfig:
    """Fill in features and calibration where the configuration has none; returns it.

    cameras: with RGB. depth_cameras: how many of them have depth, for geometry_source=rgbd. image_size: (height, width) in
    which both arrive. A checkpoint's own features stay as they are.
    """
    height, width = image_size
    if not config.image_features:
        inputs = {
            f"{OBS_IMAGES}.camera{i}": PolicyFeature(FeatureType.VISUAL, (3, height, width)) for i in range(cameras)
        }
        inputs[OBS_STATE] = PolicyFeature(FeatureType.STATE, (state_dim,))
        config.input_features = inputs | dict(config.input_features or {})
    if ACTION not in (config.output_features or {}):
        config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (min(action_dim, config.max_action_dim),))}
    if config.geometry_source == "rgbd" and not config.depth_cameras():
        count = config.geometry_pending or depth_cameras
        names = config.geometry_cameras or [f"camera{i}" for i in range(count)]
        for name in names:
            key = f"{OBS_IMAGES}.{name}{DEPTH_SUFFIX}"
            config.geometry_features[key] = PolicyFeature(FeatureType.VISUAL, (1, height, width))
            intrinsics = [float(width), float(width), width / 2, height / 2]
            config.calibration.setdefault(name, CameraCalibration(intrinsics, [width, height], _POSE))
    return config


def acting(config: PI05GeometryConfig) -> PI05GeometryConfig:
    """The configuration of a policy at inference: one that was trained on stored features runs the encoder itself."""
    return replace(config, geometry_source="da3") if config.geometry_source == "features" else config
