"""Checks of the dataset statistics that normalise state and actions."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.utils.constants import OBS_STATE

from .quantiles import WIDE_ENOUGH, covered

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig

logger = logging.getLogger(__name__)

_QUANTILES = {NormalizationMode.QUANTILES: ("q01", "q99"), NormalizationMode.QUANTILE10: ("q10", "q90")}


def check_stats(config: "PI05GeometryConfig", stats: Mapping[str, Mapping[str, Any]]) -> None:
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
