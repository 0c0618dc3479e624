"""Depth of any layout, dtype and unit becomes the same metres; what was not measured is not valid."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.depth import (
    SAMPLED_PIXELS,
    check_measured,
    check_unit,
    sample_pixels,
    to_metres,
)
from tests.geometry.scenes import generator, seeds

KEY = "observation.images.front_depth"
# No side of 1 or 3: those could be channels.
sides = st.integers(4, 9)


def random_millimetres(seed: int, batch: int, height: int, width: int) -> torch.Tensor:
    """(B, 1, H, W) int32, up to 12 m, a tenth of it zero."""
    millimetres = torch.randint(1, 12_000, (batch, 1, height, width), generator=generator(seed), dtype=torch.int32)
    return millimetres.where(torch.rand(millimetres.shape, generator=generator(seed)) > 0.1, 0)


@given(seed=seeds, batch=st.integers(1, 3), height=sides, width=sides)
def test_layouts_and_dtypes_agree(seed, batch, height, width):
    millimetres = random_millimetres(seed, batch, height, width)
    size = (height, width)
    expected, expected_valid = to_metres(millimetres, KEY, "mm", size, 10.0)
    assert expected.shape == (batch, 1, height, width)
    assert expected.dtype == torch.float32
    for dtype in (torch.uint16, torch.int16, torch.int32, torch.float32, torch.float64):
        for depth in (millimetres, millimetres.permute(0, 2, 3, 1), millimetres[:, 0]):
            metres, valid = to_metres(depth.to(dtype), KEY, "mm", size, 10.0)
            assert torch.equal(metres, expected)
            assert torch.equal(valid, expected_valid)


@given(seed=seeds, batch=st.integers(1, 3), height=sides, width=sides)
def test_millimetres_and_metres_agree(seed, batch, height, width):
    millimetres = random_millimetres(seed, batch, height, width)
    from_mm, valid_mm = to_metres(millimetres.to(torch.uint16), KEY, "mm", (height, width), 9.9995)
    from_m, valid_m = to_metres(millimetres.double() / 1000, KEY, "m", (height, width), 9.9995)
    torch.testing.assert_close(from_mm, from_m, atol=1e-6, rtol=1e-6)
    assert torch.equal(valid_mm, valid_m)


def test_far_uint16_is_far_and_not_negative():
    depth = torch.full((1, 1, 4, 4), 60_000, dtype=torch.uint16)
    metres, valid = to_metres(depth, KEY, "mm", (4, 4), 100.0)
    assert valid.all()
    torch.testing.assert_close(metres, torch.full((1, 1, 4, 4), 60.0))


@given(seed=seeds, bad=st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.5, 0.01, 4.0, 4.01]))
def test_what_was_not_measured_is_zero_and_not_valid(seed, bad):
    random = generator(seed)
    depth = 0.1 + 3.9 * torch.rand(2, 1, 6, 7, generator=random)
    hole = torch.rand(depth.shape, generator=random) < 0.3
    metres, valid = to_metres(depth.masked_fill(hole, bad), KEY, "m", (6, 7), max_depth=4.0)
    assert torch.equal(valid, ~hole)
    assert torch.equal(metres, depth.masked_fill(hole, 0.0))


def test_what_a_depth_video_makes_of_holes_and_of_far_points_is_not_valid():
    """LeRobot's codec spans 0.01 to 10 m, and writes what lies outside as its two ends."""
    depth = torch.tensor([[[10.0, 21.0, 500.0, 9_990.0, 10_000.0]]])
    _, valid = to_metres(depth, KEY, "mm", (1, 5), max_depth=10.0)
    assert valid.flatten().tolist() == [False, True, True, True, False]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.bool, torch.int64, torch.complex64])
def test_a_dtype_that_no_depth_camera_gives_is_refused(dtype):
    with pytest.raises(ValueError, match=rf"{KEY} has dtype {dtype}.*uint16 or float"):
        to_metres(torch.ones(1, 1, 4, 5, dtype=dtype), KEY, "mm", (4, 5), 10.0)


@pytest.mark.parametrize("shape", [(1, 1, 5, 4), (1, 8, 10, 1), (1, 3, 4, 5), (1, 4, 5, 3), (4, 5), (1, 1, 1, 4, 5)])
def test_a_wrong_size_is_refused(shape):
    with pytest.raises(ValueError, match=rf"{KEY} has shape .*expects depth of 4 x 5 pixels"):
        to_metres(torch.ones(shape), KEY, "m", (4, 5), 10.0)


def test_a_frame_that_is_all_nan_is_named():
    depth = torch.ones(3, 1, 4, 5)
    depth[1] = math.nan
    with pytest.raises(ValueError, match=rf"{KEY} is all NaN in sample 1 of the batch"):
        check_measured(depth, KEY)
    depth[1, 0, 2, 2] = 1.0
    check_measured(depth, KEY)
    check_measured(torch.zeros(3, 4, 5, dtype=torch.uint16), KEY)


@given(seed=seeds, median=st.floats(0.05, 10.0))
def test_a_wrong_unit_is_an_error_in_both_directions(seed, median):
    metres = median * (0.8 + 0.4 * torch.rand(2, 1, 6, 7, generator=generator(seed)))
    metres[:, :, 0] = 0.0
    metres[:, :, 1] = math.nan
    check_unit(metres, KEY, "m")
    check_unit(metres * 1000, KEY, "mm")
    with pytest.raises(ValueError, match=r"read as 'mm'.*--policy.depth_unit"):
        check_unit(metres, KEY, "mm")
    with pytest.raises(ValueError, match=r"read as 'm'.*--policy.depth_unit"):
        check_unit(metres * 1000, KEY, "m")


def test_a_wrong_unit_in_one_sample_of_a_batch_is_found():
    depth = torch.full((3, 1, 4, 5), 700.0)
    depth[1] = 0.7
    with pytest.raises(ValueError, match=r"median distance of 0.0007 m"):
        check_unit(depth, KEY, "mm")


def test_a_frame_without_measurement_says_nothing_about_the_unit():
    for nothing in (0.0, math.nan, math.inf, -1.0, 10.0):  # 10 mm is a hole in LeRobot's depth video
        check_unit(torch.full((1, 1, 4, 5), nothing), KEY, "mm")


@given(seed=seeds, share=st.floats(0.55, 0.95))
def test_holes_stored_as_the_largest_value_are_holes(seed, share):
    """Live uint16, a dataset's float millimetres and its float metres: neither a measurement nor a sign of a wrong unit."""
    millimetres = torch.randint(300, 2_000, (2, 1, 24, 32), generator=generator(seed))
    hole = torch.rand(millimetres.shape, generator=generator(seed + 1)) < share
    stored = millimetres.masked_fill(hole, 65535)
    for depth, unit in (
        (stored.to(torch.uint16), "mm"), (stored.int(), "mm"), (stored.float(), "mm"), (stored.float() / 1000, "m"),
        (stored.double() / 1000, "m"),
    ):  # fmt: skip
        check_unit(depth, KEY, unit)
        metres, valid = to_metres(depth, KEY, unit, (24, 32), max_depth=100.0)
        assert torch.equal(valid, ~hole)
        torch.testing.assert_close(metres, millimetres.masked_fill(hole, 0) / 1000)


@pytest.mark.parametrize("dtype", [torch.int16, torch.int32])
def test_the_largest_value_of_other_types_is_a_hole(dtype):
    depth = torch.full((1, 1, 4, 4), torch.iinfo(dtype).max, dtype=dtype)
    depth[..., 0] = 700
    check_unit(depth, KEY, "mm")
    assert to_metres(depth, KEY, "mm", (4, 4), 1e9)[1].sum() == 4


def test_values_are_checked_on_a_sample_of_pixels_from_every_row_and_column():
    for height, width in ((480, 640), (84, 84), (224, 224), (512, 512), (7, 9), (1, 1)):
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        for coordinate, size in ((u, width), (v, height)):
            seen = sample_pixels(coordinate.reshape(1, height, width, 1)).unique()
            assert len(seen) >= min(size, SAMPLED_PIXELS) * 0.9
        assert sample_pixels(u[None]).shape[1] < 2 * SAMPLED_PIXELS


def test_the_error_of_a_wrong_unit_says_what_streaming_does():
    """LeRobot ignores --dataset.depth_output_unit there, so the declared unit may be the right one."""
    with pytest.raises(
        ValueError, match=r"with --dataset.streaming=true and with --dataset.eval_split above 0, and reads 'mm'"
    ):
        check_unit(torch.full((1, 1, 4, 5), 700.0), KEY, "m")
