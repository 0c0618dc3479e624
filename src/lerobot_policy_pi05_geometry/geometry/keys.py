"""Names of observations that belong to geometry."""

from collections.abc import Mapping

from torch import Tensor

DEPTH_SUFFIX = "_depth"
IMAGE_PREFIX = "observation.images."
CALIBRATION_PREFIX = "observation.calibration."


def camera_of(image_key: str) -> str:
    """Name of the camera whose images stand under this key."""
    return image_key.removeprefix(IMAGE_PREFIX).removeprefix("observation.")


def depth_key(camera: str) -> str:
    """Where the depth of a camera stands in a batch."""
    return f"{IMAGE_PREFIX}{camera}{DEPTH_SUFFIX}"


def extrinsics_key(camera: str) -> str:
    """Where the pose of a camera stands in a batch, if it comes with every frame."""
    return f"{CALIBRATION_PREFIX}{camera}.extrinsics"


def is_geometry_key(key: str) -> bool:
    """Whether an observation key belongs to geometry: depth of a camera, or camera calibration."""
    return key.startswith(CALIBRATION_PREFIX) or (key.startswith(IMAGE_PREFIX) and key.endswith(DEPTH_SUFFIX))


def batch_like(batch: Mapping[str, Tensor]) -> Tensor:
    """An observation tensor that surely has a batch dimension, to take batch size and device from.

    A pose may come as (4, 4), once for the whole batch, so it is asked last.
    """
    observed = [key for key, value in batch.items() if key.startswith("observation.") and isinstance(value, Tensor)]
    return batch[min(observed, key=lambda key: key.startswith(CALIBRATION_PREFIX))]
