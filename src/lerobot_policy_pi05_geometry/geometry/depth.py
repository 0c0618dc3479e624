"""Depth of any layout, dtype and unit -> metres and valid pixels.

LeRobot's robots give uint16 millimetres (H, W, 1), its datasets float millimetres (1, H, W) unless told metres, its
environments float32 (B, H, W, 1). The unit cannot be guessed from the numbers, so it is declared (`depth_unit`), and a
scene that is then implausible is an error.
"""

import math

import torch
from torch import Tensor

METRES_PER_UNIT = {"m": 1.0, "mm": 1e-3}
# Median distance of what a manipulator's camera sees; outside it the declared unit is wrong.
PLAUSIBLE_MEDIAN = (0.02, 20.0)
# LeRobot's 12-bit depth video spans 0.01 to 10 m: a hole (0) reads back as 0.01 m, and all that is farther as 10 m.
# Neither is a measurement, so valid depth is above MIN_DEPTH and below the configured maximum.
MIN_DEPTH = 0.02
_CODEC_FLOOR = 0.01
_BOUND_WIDTH = 0.0005  # metres: LeRobot rounds to millimetres when it decodes
# LeRobot takes one count of a camera's raw depth for a millimetre, whatever the camera's scale is.
LEROBOT_COUNT = 1e-3
_UINT16_MAX = 65535
# Pixels of a frame that its values are checked on: the median of 1,024 of them is within 3 percentiles of the whole frame's.
SAMPLED_PIXELS = 1024
_DTYPES = (torch.uint16, torch.int16, torch.int32, torch.float16, torch.float32, torch.float64)


def to_metres(
    depth: Tensor,
    key: str,
    unit: str,
    size: tuple[int, int],
    max_depth: float,
    factor: Tensor | float = 1.0,
    bounds: tuple[float, float] = (0.0, math.inf),
) -> tuple[Tensor, Tensor]:
    """Normalise a depth batch.

    depth: (B, 1, H, W), (B, H, W, 1) or (B, H, W). key: its name, for messages. unit: "mm" or "m". size: (H, W) that
    the policy was configured with. max_depth: metres; what is as far or farther counts as not measured. factor: true metres per
    declared metre, a number or (B,): the camera's depth scale over LeRobot's. bounds: declared metres at which the data's codec
    ends: holes read back as the lower one, all that is farther as the upper one.

    Returns depth in metres, z along the optical axis, (B, 1, H, W) float32 with zeros where not valid, and validity
    (B, 1, H, W) bool. NaN, inf, nearer than MIN_DEPTH, too far and the type's largest value are not valid.

    Raises ValueError for a dtype that no depth camera gives or a wrong size.
    """
    check_dtype(depth, key)
    if depth.ndim == 3:
        depth = depth[:, None]
    elif depth.ndim == 4 and depth.shape[1] != 1 and depth.shape[-1] == 1:
        depth = depth.permute(0, 3, 1, 2)
    if depth.ndim != 4 or depth.shape[1] != 1 or tuple(depth.shape[-2:]) != tuple(size):
        raise ValueError(
            f"{key} has shape {tuple(depth.shape)}, but this policy expects depth of {size[0]} x {size[1]} pixels "
            "(height x width, one channel); use the camera resolution it was trained with."
        )
    declared = depth.float() * METRES_PER_UNIT[unit]
    metres = declared * _per_row(factor, 4)
    # Comparisons with NaN are False.
    valid = (metres > MIN_DEPTH) & (metres < max_depth) & within(declared, bounds) & ~is_largest_value(depth, unit)
    return metres.masked_fill(~valid, 0.0), valid


def check_dtype(depth: Tensor, key: str) -> None:
    """Raise ValueError for a dtype that no depth camera gives."""
    if depth.dtype not in _DTYPES:
        raise ValueError(
            f"{key} has dtype {depth.dtype}, but depth must be uint16 or float in the declared unit (--policy.depth_unit); an "
            "8-bit depth image has lost its distances, so record the camera's raw depth."
        )


def within(declared: Tensor, bounds: tuple[float, float]) -> Tensor:
    """Where declared metres are inside of the codec's bounds, and not at them."""
    low, high = bounds
    return (declared > (low + _BOUND_WIDTH if low > 0 else 0.0)) & (declared < high - _BOUND_WIDTH)


def _per_row(factor: Tensor | float, dimensions: int) -> Tensor | float:
    """A number, or (B,) as (B, 1, ...)."""
    return factor.reshape(-1, *[1] * (dimensions - 1)) if isinstance(factor, Tensor) else factor


def is_largest_value(depth: Tensor, unit: str) -> Tensor:
    """Where raw depth is the largest value of the type it was recorded in, by which many cameras say "not measured".

    That is 65535 for uint16. LeRobot's datasets return such a pixel as a float of the same number of millimetres, so
    floats are compared with it too.
    """
    values = depth.float()
    if depth.dtype.is_floating_point:
        largest = _UINT16_MAX * METRES_PER_UNIT["mm"] / METRES_PER_UNIT[unit]
        return (values - largest).abs() < 1e-6 * largest
    return (values == _UINT16_MAX) | (values == torch.iinfo(depth.dtype).max)


def sample_pixels(depth: Tensor) -> Tensor:
    """Pixels of every frame, spread over all its rows and columns: (B, ...) -> (B, about SAMPLED_PIXELS)."""
    pixels = depth.flatten(1)
    step = max(1, pixels.shape[1] // SAMPLED_PIXELS)
    while math.gcd(step, pixels.shape[1]) != 1:  # otherwise some columns are never seen
        step += 1
    return pixels[:, ::step]


def check_measured(depth: Tensor, key: str) -> None:
    """Raise ValueError if a frame is all NaN. depth: as given to `to_metres`, batch first."""
    suspects = sample_pixels(depth).float().isnan().all(dim=1).nonzero().flatten().tolist()
    for sample in suspects:
        if depth[sample].float().isnan().all():
            raise ValueError(
                f"{key} is all NaN in sample {sample} of the batch, so the depth camera measured nothing; drop the frame "
                "from the dataset, or store 0 for pixels without a measurement."
            )


def check_unit(
    depth: Tensor,
    key: str,
    unit: str,
    factor: Tensor | float = 1.0,
    bounds: tuple[float, float] = (0.0, math.inf),
) -> None:
    """Raise ValueError if the distances show that the declared unit is wrong. A sample of pixels decides.

    depth, factor, bounds: as given to `to_metres`, before validity (a wrong unit would make everything "too far").
    """
    pixels = sample_pixels(depth)
    metres = pixels.float() * METRES_PER_UNIT[unit]
    seen = (
        within(metres, bounds)
        & metres.isfinite()
        & (metres > 0)
        & ((metres - _CODEC_FLOOR).abs() > 1e-4)
        & ~is_largest_value(pixels, unit)
    )
    metres = (metres * _per_row(factor, 2)).masked_fill(~seen, float("nan")).nanmedian(dim=1).values
    low, high = PLAUSIBLE_MEDIAN
    wrong = (metres < low) | (metres > high)  # NaN (nothing measured) is neither
    if wrong.any():
        raise ValueError(
            f"{key} has a median distance of {metres[wrong][0].item():.4g} m when read as '{unit}', outside {low}-{high} "
            "m: the unit is probably wrong; set --policy.depth_unit to the unit of the data ('mm' or 'm'; LeRobot "
            "datasets are read as --dataset.depth_output_unit says, 'mm' by default, but LeRobot ignores that option with "
            "--dataset.streaming=true and with --dataset.eval_split above 0, and reads 'mm')."
        )
