"""What a dataset says about its depth: the bounds of its codec, and whether it is a camera's raw counts."""

import logging
from collections.abc import Mapping
from typing import Any

from lerobot.configs.video import encoder_config_from_video_info

from .calibration import Rig
from .keys import find_depth_key

logger = logging.getLogger(__name__)

# Robots of LeRobot 0.6 whose depth is a RealSense's raw counts.
_RAW_DEPTH_ROBOTS = ("follower", "so100", "so101", "koch", "omx", "openarm", "hope_jr", "unitree_g1", "rebot")


def codec_bounds(
    features: Mapping[str, Mapping[str, Any]], cameras: list[str], depth_keys: Mapping[str, str]
) -> dict[str, list[float]]:
    """Per camera whose depth is a video: [depth_min, depth_max] in metres, at which LeRobot's codec ends.

    Raises ValueError where merging datasets of other bounds has left none: LeRobot would decode with its defaults.
    """
    bounds = {}
    for camera in cameras:
        key = find_depth_key(camera, features, depth_keys)
        if key is None or features[key].get("dtype") != "video":
            continue
        info = dict(features[key].get("info") or {})
        lost = [name for name in ("video.depth_min", "video.depth_max") if name in info and info[name] is None]
        if lost:
            raise ValueError(
                f"{key} has lost {' and '.join(lost)} in meta/info.json (LeRobot drops them when it merges datasets whose bounds "
                "differ), so its depth cannot be decoded; encode the datasets with the same depth_min and depth_max, "
                "and merge again."
            )
        encoder = encoder_config_from_video_info({**info, "is_depth_map": True})
        bounds[camera] = [float(encoder.depth_min), float(encoder.depth_max)]
    return bounds


def check_depth_scale(
    rigs: Mapping[int, Rig], dataset_meta: Any, cameras: list[str], depth_keys: Mapping[str, str]
) -> None:
    """Raise ValueError for a real robot's raw depth whose scale nobody has said; warn where it may be such data.

    LeRobot records raw counts as millimetres, whatever the camera. A D405 counts in 0.1 mm.
    """
    missing = [c for c in cameras if any(rig.cameras[c].depth_scale is None for rig in rigs.values())]
    raw = [
        camera
        for camera in missing
        if (key := find_depth_key(camera, dataset_meta.features, depth_keys)) is not None
        and (dataset_meta.features[key].get("info") or {}).get("depth_unit") == "mm"
    ]
    if not raw:
        return
    robot = str(getattr(dataset_meta, "robot_type", None) or "")
    told = (
        f"The calibration has no depth_scale of camera(s) {', '.join(raw)}, and LeRobot records a RealSense's raw counts as "
        "millimetres (a D405 counts in 0.1 mm: every point would be ten times too far); read it from the camera with "
        "`pi05-geometry "
        "calibrate camera`, or write 0.001 for depth in true millimetres."
    )
    if any(name in robot for name in _RAW_DEPTH_ROBOTS):
        raise ValueError(told)
    if "metaworld" not in robot and "sim" not in robot:
        logger.warning(told)
