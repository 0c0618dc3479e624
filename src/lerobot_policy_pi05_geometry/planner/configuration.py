"""Completes a configuration as a dataset would."""

from collections.abc import Iterable
from dataclasses import replace

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry import CameraCalibration
from ..geometry.keys import DEPTH_SUFFIX, is_depth_key
from ..geometry.resolve import FROM_RGB

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

    cameras: with RGB. depth_cameras: how many of them have depth, for geometry_source=rgbd; with geometry_cameras, those.
    image_size: (height, width) in which both arrive. A checkpoint's own features stay as they are.
    """
    height, width = image_size
    wanted = list(config.geometry_cameras or [])
    names = wanted + [name for i in range(cameras) if (name := f"camera{i}") not in wanted]
    if not config.image_features:
        inputs = {
            f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, (3, height, width))
            for name in names[: max(cameras, len(wanted))]
        }
        inputs[OBS_STATE] = PolicyFeature(FeatureType.STATE, (state_dim,))
        config.input_features = inputs | dict(config.input_features or {})
    if ACTION not in (config.output_features or {}):
        config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (min(action_dim, config.max_action_dim),))}
    if config.geometry_source == "rgbd" and not any(
        is_depth_key(k, config.depth_keys) for k in config.geometry_features
    ):
        count = config.geometry_pending or depth_cameras
        for name in wanted or [f"camera{i}" for i in range(count)]:
            key = f"{OBS_IMAGES}.{name}{DEPTH_SUFFIX}"
            config.geometry_features[key] = PolicyFeature(FeatureType.VISUAL, (1, height, width))
    for name in _calibrated(config) if not config.rigs else ():
        intrinsics = [float(width), float(width), width / 2, height / 2]
        config.calibration.setdefault(name, CameraCalibration(intrinsics, [width, height], _POSE))
    return config


def _calibrated(config: PI05GeometryConfig) -> Iterable[str]:
    """The cameras whose calibration geometry needs."""
    if config.geometry_source == "rgbd":
        return config.depth_cameras()
    rays = config.geometry_source == "rays" or (config.geometry_source in FROM_RGB and config.geometry_tokens == "rays")
    return config.rgb_cameras() if rays else ()


def acting(config: PI05GeometryConfig) -> PI05GeometryConfig:
    """The configuration of a policy at inference: one that was trained on stored features runs the encoder itself."""
    return replace(config, geometry_source="da3") if config.geometry_source == "features" else config
