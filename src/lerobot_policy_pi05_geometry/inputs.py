"""What arrives from LeRobot, checked and put into the network's form: images, dataset statistics, calibration."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from .configuration_pi05_geometry import PI05GeometryConfig
from .geometry import CameraCalibration, read_calibration_file
from .geometry.calibration import CALIBRATION_FILE
from .geometry.images import rgb_image
from .geometry.keys import extrinsics_key
from .quantiles import WIDE_ENOUGH, covered

logger = logging.getLogger(__name__)

_QUANTILES = {NormalizationMode.QUANTILES: ("q01", "q99"), NormalizationMode.QUANTILE10: ("q10", "q90")}


def prepare_images(
    batch: Mapping[str, Tensor], config: PI05GeometryConfig, device: torch.device
) -> tuple[list[Tensor | None], list[Tensor]]:
    """RGB cameras in the form SigLIP expects.

    Images are (B, 3, H, W) or (B, H, W, 3), uint8 or float in [0, 1]; they are resized with black padding to
    `image_resolution` and scaled to [-1, 1], as openpi does.

    Returns per camera the images (B, 3, S, S) float32, or None for a camera that may be absent and is, and its mask (B,).
    Raises ValueError for a camera that is missing or has a wrong shape.
    """
    images: list[Tensor | None] = []
    masks = []
    size = batch["observation.language.tokens"].shape[0]
    for key in config.image_features:
        absent = key not in batch
        if absent and not config.may_be_absent(key):
            raise ValueError(
                f"The observation has no image {key}; connect the camera, rename its key with --rename_map, or, if "
                f"this policy may run without it, list it in --policy.absent_cameras='[\"{key}\"]'."
            )
        images.append(None if absent else _prepare_image(batch[key].to(device), key, config))
        masks.append(torch.full((size,), not absent, device=device))
    return images, masks


def _prepare_image(image: Tensor, key: str, config: PI05GeometryConfig) -> Tensor:
    image = rgb_image(image, key)
    if tuple(image.shape[-2:]) != tuple(config.image_resolution):
        image = resize_with_pad_torch(image, *config.image_resolution)
    return image * 2.0 - 1.0


def check_stats(config: PI05GeometryConfig, stats: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that the dataset statistics can normalise what `normalization_mapping` wants normalised.

    LeRobot divides by an epsilon where two quantiles coincide, which turns any other value into millions. A dimension
    that is constant throughout is harmless and only reported; so is a state whose quantiles cover little of its range.

    Raises ValueError naming the feature, the dimension and what to do.
    """
    features = {**(config.input_features or {}), **(config.output_features or {})}
    for key, feature in features.items():
        mode = config.normalization_mapping.get(FeatureType(feature.type).value, NormalizationMode.IDENTITY)
        filled_in = key == OBS_STATE and key not in stats  # a state that the data lacks
        if mode not in _QUANTILES or filled_in:
            continue
        low_name, high_name = _QUANTILES[mode]
        if low_name not in stats.get(key, {}) or high_name not in stats[key]:
            raise ValueError(
                f"The dataset has no {low_name}/{high_name} statistics for {key}, which {mode.value} normalisation needs; "
                "add them with `pi05-geometry quantiles --dataset.root=...`, or choose another --policy.normalization_mapping."
            )
        low, high = (torch.as_tensor(stats[key][name]).flatten().double() for name in (low_name, high_name))
        for dim in (high <= low).nonzero().flatten().tolist():
            values = [torch.as_tensor(stats[key][n]).flatten()[dim].item() for n in ("min", "max") if n in stats[key]]
            if len(values) == 2 and values[0] == values[1]:
                logger.warning(
                    "%s[%d] is constant (%g) in the dataset; it carries no information.", key, dim, values[0]
                )
                continue
            raise ValueError(
                f"{key}[{dim}] has {low_name} = {low[dim].item():g} and {high_name} = {high[dim].item():g} although it is not "
                f"constant, so its {mode.value} normalisation has no width; drop the dimension, or use MEAN_STD or MIN_MAX in "
                "--policy.normalization_mapping."
            )
        if key == OBS_STATE and {"min", "max"} <= set(stats[key]):
            narrow = (covered(stats[key], low_name, high_name) < WIDE_ENOUGH).nonzero()[0].tolist()
            _warn_of_narrow_quantiles(narrow)


def _warn_of_narrow_quantiles(narrow: list[int]) -> None:
    if narrow:
        logger.warning(
            "The quantiles of %s%s span less than half of its range, and what lies outside them is clipped in the prompt. "
            "LeRobot averages the quantiles of single episodes; `pi05-geometry quantiles --dataset.root=...` takes them "
            "over all frames.", OBS_STATE, narrow,
        )  # fmt: skip


def resolve_calibration(config: PI05GeometryConfig, dataset_meta: Any | None) -> dict[str, CameraCalibration]:
    """The calibration to use: the file given, else what the checkpoint recorded, else the dataset's.

    The caller stores it in the configuration, so that a checkpoint carries it wherever it goes.
    Raises ValueError if the dataset's differs from the recorded one and no file says which of them holds.
    """
    if config.calibration_path is not None:
        return read_calibration_file(config.calibration_path)
    path = None if dataset_meta is None else Path(dataset_meta.root) / "meta" / CALIBRATION_FILE
    if path is None or not path.is_file():
        return config.calibration
    of_dataset = read_calibration_file(path)
    if config.calibration and config.calibration != of_dataset and not config.calibration_given:
        raise ValueError(
            f"The dataset's calibration ({path}) differs from the one recorded in the checkpoint; say which holds with "
            "--policy.calibration_path."
        )
    return config.calibration or of_dataset


def check_calibration(config: PI05GeometryConfig, cameras: list[str]) -> None:
    """Raise ValueError unless every depth camera has usable intrinsics."""
    for camera in cameras:
        if camera not in config.calibration:
            known = ", ".join(sorted(config.calibration)) or "no camera"
            raise ValueError(
                f"Depth camera '{camera}' has no intrinsics (the calibration has {known}); give a calibration file with "
                "--policy.calibration_path, or put it at meta/calibration.json of the dataset."
            )
        config.calibration[camera].check(camera)
        posed = config.calibration[camera].extrinsics is not None or extrinsics_key(camera) in config.geometry_features
        if config.geometry_frame == "base" and not posed:
            raise ValueError(
                f"Depth camera '{camera}' has no extrinsics: neither in its calibration nor as {extrinsics_key(camera)} in "
                "the data; give them, or set --policy.geometry_frame=camera."
            )
