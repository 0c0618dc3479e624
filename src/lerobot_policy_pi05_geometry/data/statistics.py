"""Checks of the dataset statistics that normalise state and actions."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from .quantiles import WIDE_ENOUGH, action_kind, covered

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig

logger = logging.getLogger(__name__)

_QUANTILES = {NormalizationMode.QUANTILES: ("q01", "q99"), NormalizationMode.QUANTILE10: ("q10", "q90")}
_USED = {
    **_QUANTILES,
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.IDENTITY: (),
}
# How far normalised actions may reach; their quantiles are at -1 and 1. A loss is a square: one frame in a hundred at 50
# adds 25 to it, where noise alone gives about 1.
FAR, TOO_FAR = 5.0, 50.0
RELATIVE_STATISTICS = "`lerobot-edit-dataset --operation.type recompute_stats --operation.relative_action true`"


def check_stats(config: "PI05GeometryConfig", stats: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that dataset statistics can normalise what the policy reads and predicts.

    LeRobot divides by an epsilon where two quantiles coincide, so that any other value becomes millions, and by a tiny
    width where a dimension hardly moves, so that the frames in which it moves become thousands. Reported but accepted: a
    dimension that is constant throughout, a state whose quantiles cover little of its range, and an action that reaches far.

    Raises ValueError naming the feature, the dimension and what to do.
    """
    for key, (mode, names) in _to_check(config, stats).items():
        given = {name: torch.as_tensor(value).flatten().double() for name, value in stats.get(key, {}).items()}
        _require_numbers(config, key, mode, names, given)
        if mode in _QUANTILES:
            _check_widths(key, mode, names, given)
            if key == ACTION:
                _check_reach(names, given)
            elif {"min", "max"} <= set(given):
                _warn_of_narrow_quantiles((covered(given, *names) < WIDE_ENOUGH).nonzero()[0].tolist())
        elif mode is NormalizationMode.MEAN_STD and key == ACTION and config.use_relative_actions:
            _require_spread(given["std"])


def require_matching_kind(config: "PI05GeometryConfig", dataset_meta: Any) -> None:
    """Raise ValueError if the action statistics are of relative actions and the policy's are absolute, or the reverse."""
    kind = action_kind(dataset_meta)
    if config.normalization_mapping.get("ACTION") is NormalizationMode.IDENTITY or kind is None:
        return
    if config.use_relative_actions and kind == "absolute":
        raise ValueError(
            "use_relative_actions needs statistics of relative actions, but the dataset's are of absolute ones; compute them "
            f"with {RELATIVE_STATISTICS}."
        )
    if not config.use_relative_actions and kind == "relative":
        raise ValueError(
            "The dataset's action statistics are of relative actions, but the policy's actions are absolute; set "
            "--policy.use_relative_actions=true, or make them absolute again with `lerobot-edit-dataset --operation.type "
            "recompute_stats`."
        )


def _to_check(
    config: "PI05GeometryConfig", stats: Mapping[str, Mapping[str, Any]]
) -> dict[str, tuple[NormalizationMode, tuple[str, ...]]]:
    """What the policy reads or predicts: its normalisation, and the statistics which that uses."""
    features = {**(config.input_features or {}), **(config.output_features or {})}
    found = {}
    for key in (OBS_STATE, ACTION):
        filled_in = key == OBS_STATE and key not in stats  # a state that the data lacks
        if key in features and not filled_in:
            kind = FeatureType(features[key].type).value
            mode = config.normalization_mapping.get(kind, NormalizationMode.IDENTITY)
            found[key] = mode, _USED[mode]
    return found


def _require_numbers(
    config: "PI05GeometryConfig",
    key: str,
    mode: NormalizationMode,
    names: tuple[str, ...],
    given: Mapping[str, Tensor],
) -> None:
    if any(name not in given for name in names):
        command = "`pi05-geometry quantiles --dataset.root=...`" if key == OBS_STATE else _action_command(config)
        raise ValueError(
            f"The dataset has no {'/'.join(names)} statistics for {key}, which {mode.value} normalisation needs; add them "
            f"with {command}, or choose another --policy.normalization_mapping."
        )
    for name, values in given.items():
        bad = (~values.isfinite()).nonzero().flatten().tolist()
        if bad:
            raise ValueError(
                f"The statistic {name} of {key}[{bad[0]}] is {values[bad[0]].item()}, so at least one frame has such a value; "
                "correct it or leave out its episode (`lerobot-edit-dataset`), and recompute the statistics."
            )


def _action_command(config: "PI05GeometryConfig") -> str:
    return (
        RELATIVE_STATISTICS if config.use_relative_actions else "`pi05-geometry quantiles --actions --dataset.root=...`"
    )


def _check_widths(key: str, mode: NormalizationMode, names: tuple[str, ...], given: Mapping[str, Tensor]) -> None:
    """Two quantiles that coincide: fine for a constant, an error for anything else."""
    low_name, high_name = names
    low, high = given[low_name], given[high_name]
    for dim in (high <= low).nonzero().flatten().tolist():
        values = [given[name][dim].item() for name in ("min", "max") if name in given]
        if len(values) == 2 and values[0] == values[1]:
            logger.warning("%s[%d] is constant (%g) in the dataset; it carries no information.", key, dim, values[0])
            continue
        raise ValueError(
            f"{key}[{dim}] has {low_name} = {low[dim].item():g} and {high_name} = {high[dim].item():g} although it is not "
            f"constant, so its {mode.value} normalisation has no width; {_remedy(key, dim)}."
        )


def _check_reach(names: tuple[str, ...], given: Mapping[str, Tensor]) -> None:
    """How far the most distant action is from the range that the quantiles become, -1 to 1."""
    if not {"min", "max"} <= set(given):
        return
    low, high = (given[name] for name in names)
    width = high - low
    outermost = torch.maximum(given["max"] - high, low - given["min"])
    reach = torch.where(width > 0, 1 + 2 * outermost / width, 0.0)
    for dim in (reach > FAR).nonzero().flatten().tolist():
        told = (
            f"{ACTION}[{dim}] reaches {reach[dim].item():.4g} in normalised units: its {names[0]} and {names[1]} are "
            f"{width[dim].item():.3g} apart, but it goes from {given['min'][dim].item():g} to {given['max'][dim].item():g}"
        )
        if reach[dim] > TOO_FAR:
            raise ValueError(f"{told}. The loss would be about these frames alone; {_remedy(ACTION, dim)}.")
        logger.warning("%s; %s.", told, _remedy(ACTION, dim))


def _remedy(key: str, dim: int) -> str:
    return (
        f"let this dimension use its whole range with `pi05-geometry quantiles --full-range {key}:{dim} --dataset.root=...`, "
        "which keeps the quantiles of the others, or drop it"
    )


def _require_spread(std: Tensor) -> None:
    """Relative actions leave the policy absolute; a dimension that is multiplied by 0 cannot carry the state."""
    still = np.flatnonzero(std.numpy() <= 0).tolist()
    if still:
        raise ValueError(
            f"The relative {ACTION}{still} have a standard deviation of 0, which MEAN_STD cannot normalise; use QUANTILES or "
            "MIN_MAX in --policy.normalization_mapping, or --policy.relative_exclude_joints."
        )


def _warn_of_narrow_quantiles(narrow: list[int]) -> None:
    if narrow:
        logger.warning(
            "The quantiles of %s%s span less than half of its range, and what lies outside them is clipped in the prompt. "
            "LeRobot averages the quantiles of single episodes; `pi05-geometry quantiles --dataset.root=...` takes them "
            "over all frames.", OBS_STATE, narrow,
        )  # fmt: skip
