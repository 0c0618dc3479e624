"""Names of observations that belong to geometry, and of the cameras behind them.

Depth of a camera stands under `observation.images.<camera>_depth`, LeRobot's own name. A dataset may name it otherwise; then
`depth_keys` says which key holds the depth of which camera. It is found by LeRobot's flag `is_depth_map`, or given by the user.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from torch import Tensor

DEPTH_SUFFIX = "_depth"
IMAGE_PREFIX = "observation.images."
CALIBRATION_PREFIX = "observation.calibration."
_OBSERVATION_PREFIX = "observation."
RAW_STATE = "observation.raw_state"  # the state before normalisation, which forward kinematics needs
# What a training sample's depth augmentation is drawn from, (B,) int64. The policy adds it to training batches alone.
AUGMENTATION_KEY = "augmentation_key"
RIG = f"{CALIBRATION_PREFIX}rig"  # which rig a frame of merged data is from, (B,) or (B, 1)


def camera_of(image_key: str) -> str:
    """Name of the camera whose images stand under this key."""
    return image_key.removeprefix(IMAGE_PREFIX).removeprefix(_OBSERVATION_PREFIX)


def depth_key(camera: str) -> str:
    """LeRobot's name for the depth of a camera."""
    return f"{IMAGE_PREFIX}{camera}{DEPTH_SUFFIX}"


def extrinsics_key(camera: str) -> str:
    """Where the pose of a camera stands in a batch, if it comes with every frame."""
    return f"{CALIBRATION_PREFIX}{camera}.extrinsics"


def is_depth_key(key: str, depth_keys: Mapping[str, str] | None = None) -> bool:
    """Whether an observation key holds depth, by LeRobot's naming or by `depth_keys` (camera -> key)."""
    named = key.startswith(IMAGE_PREFIX) and key.endswith(DEPTH_SUFFIX)
    return named or key in (depth_keys or {}).values()


def is_geometry_key(key: str, depth_keys: Mapping[str, str] | None = None) -> bool:
    """Whether an observation key belongs to geometry: depth of a camera, or camera calibration."""
    return key.startswith(CALIBRATION_PREFIX) or is_depth_key(key, depth_keys)


def find_depth_key(camera: str, batch: Mapping[str, Any], depth_keys: Mapping[str, str]) -> str | None:
    """The key of a camera's depth in a batch: the one of `depth_keys`, else LeRobot's own; None if neither is there.

    A policy trained on a dataset with another name thus reads a robot or an environment that uses LeRobot's.
    """
    for key in (depth_keys.get(camera), depth_key(camera)):
        if key is not None and key in batch:
            return key
    return None


def is_depth_map(feature: Mapping[str, Any]) -> bool:
    """Whether a dataset's feature carries LeRobot's flag for depth, in its present or its earlier place."""
    info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def depth_camera_name(key: str) -> str:
    """The camera that a depth key belongs to: the key without `observation.images.` and the word "depth".

    `observation.images.depth.front`, `observation.depth_front` and `observation.images.front_depth` are all of `front`.
    """
    rest = camera_of(key)
    if is_depth_key(key):
        return rest.removesuffix(DEPTH_SUFFIX)
    return re.sub(r"(^|[._])depth(?=[._]|$)", "", rest).strip("._") or rest


def find_depth_keys(features: Mapping[str, Mapping[str, Any]], given: Mapping[str, str]) -> dict[str, str]:
    """`depth_keys` of a dataset: those given, and depth maps that are not named as LeRobot names them.

    features: of the dataset, in LeRobot's description. given: camera -> key, said by the user.
    Raises ValueError if two depth maps would belong to one camera.
    """
    found = dict(given)
    for key, feature in features.items():
        if not is_depth_map(feature) or is_depth_key(key, found):
            continue
        camera = depth_camera_name(key)
        other = found.get(camera, depth_key(camera))
        if other in features:
            raise ValueError(
                f"The depth maps {other} and {key} would both belong to camera '{camera}'; name their cameras with "
                f"""--policy.depth_keys='{{"{camera}": "{other}", "<another name>": "{key}"}}'."""
            )
        found[camera] = key
    return found


def depth_features(features: Mapping[str, Mapping[str, Any]], given: Mapping[str, str]) -> dict[str, str]:
    """Camera -> key of every depth feature of a dataset. features, given: as in `find_depth_keys`."""
    depth_keys = find_depth_keys(features, given)
    named = {key: camera for camera, key in depth_keys.items()}
    return {
        named.get(key) or depth_camera_name(key): key
        for key, feature in features.items()
        if is_depth_key(key, depth_keys) and not _is_colour(feature)
    }


def _is_colour(feature: Mapping[str, Any]) -> bool:
    """Whether a feature has three channels: a depth map that was turned into colours."""
    shape = feature["shape"]
    return len(shape) == 3 and 3 in (shape[0], shape[-1])


def select_cameras[T](found: Mapping[str, T], wanted: Iterable[str] | None, what: str) -> dict[str, T]:
    """The wanted cameras in their order, or all of them sorted by name. what: what they have, for the message.

    Raises ValueError naming a wanted camera that is not there.
    """
    if wanted is None:
        return dict(sorted(found.items()))
    wanted = list(wanted)
    unknown = [camera for camera in wanted if camera not in found]
    if unknown:
        raise ValueError(
            f"geometry_cameras names {', '.join(unknown)}, but the data has {what} from "
            f"{', '.join(sorted(found)) or 'no camera'} only."
        )
    return {camera: found[camera] for camera in wanted}


def batch_like(batch: Mapping[str, Tensor]) -> Tensor:
    """An observation tensor that surely has a batch dimension, to take batch size and device from.

    A pose may come once for the whole batch, without a batch dimension, so poses are asked last.
    """
    observed = [key for key, value in batch.items() if key.startswith("observation.") and isinstance(value, Tensor)]
    return batch[min(observed, key=lambda key: key.startswith(CALIBRATION_PREFIX))]
