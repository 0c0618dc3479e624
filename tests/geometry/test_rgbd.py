"""Geometry from depth cameras: what is computed, what never gets in, and what is refused."""

import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.rgbd import WAVELENGTHS, cell_statistics, depth_key, extrinsics_key
from tests.geometry.scenes import (
    calibrated,
    camera_above_table,
    depth_of_plane,
    generator,
    grids,
    make_source,
    project,
    random_depth,
    random_observation,
    random_pose,
    seeds,
    uniform,
)

MEAN, SPREAD, FRACTION, FOURIER = slice(0, 3), slice(3, 6), 6, slice(7, None)


# --- cells --------------------------------------------------------------------------------------------------------


def brute_force_cell(points: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Features (C,) float64 of one cell with points (3, h, w) and validity (h, w)."""
    if not valid.any():
        return torch.zeros(7 + 6 * len(WAVELENGTHS), dtype=torch.float64)
    measured = points[:, valid].double()
    mean = measured.mean(dim=1)
    spread = (measured - mean[:, None]).square().mean(dim=1).sqrt()
    angles = torch.cat([2 * math.pi * mean / wavelength for wavelength in WAVELENGTHS])
    return torch.cat([mean, spread, valid.double().mean()[None], angles.sin(), angles.cos()])


@given(seed=seeds, grid=grids, rows=st.integers(1, 4), columns=st.integers(1, 4), share=st.floats(0.05, 1.0))
def test_cells_equal_a_brute_force_loop(seed, grid, rows, columns, share):
    random = generator(seed)
    points = uniform(random, -2.0, 2.0, 2, 3, grid * rows, grid * columns)
    valid = torch.rand(2, 1, grid * rows, grid * columns, generator=random) < share
    features, seen = cell_statistics(points, valid, grid)
    assert features.shape == (2, grid**2, 7 + 6 * len(WAVELENGTHS))
    assert seen.shape == (2, grid**2)
    for row in range(2):
        for cell in range(grid**2):
            top, left = cell // grid * rows, cell % grid * columns
            window = (slice(top, top + rows), slice(left, left + columns))
            inside = valid[row, 0][window]
            assert bool(seen[row, cell]) == bool(inside.any())
            expected = brute_force_cell(points[row][:, *window], inside)
            torch.testing.assert_close(features[row, cell].double(), expected, atol=2e-3, rtol=0)


@pytest.mark.parametrize("grid", [1, 3, 5])
def test_a_cell_without_a_valid_pixel_is_masked_and_zero(grid):
    points = torch.full((1, 3, 4 * grid, 4 * grid), 0.7)
    valid = torch.ones(1, 1, 4 * grid, 4 * grid, dtype=torch.bool)
    valid[..., -4:, -4:] = False  # the last cell
    features, seen = cell_statistics(points.masked_fill(~valid, math.nan), valid, grid)
    assert seen[0].tolist() == [True] * (grid**2 - 1) + [False]
    assert features[0, -1].eq(0).all()
    assert features.isfinite().all()


@pytest.mark.parametrize("grid", [3, 5, 8])
def test_sides_need_not_be_multiples_of_the_grid(grid):
    features, seen = cell_statistics(torch.full((1, 3, 10, 13), 0.7), torch.ones(1, 1, 10, 13, dtype=torch.bool), grid)
    assert seen.all()
    torch.testing.assert_close(features[..., MEAN], torch.full((1, grid**2, 3), 0.7))
    torch.testing.assert_close(features[..., FRACTION], torch.ones(1, grid**2))


# --- points -------------------------------------------------------------------------------------------------------


@given(seed=seeds, grid=st.sampled_from([1, 3, 4]), height_of_plane=st.floats(-0.2, 0.3))
def test_a_table_is_flat_in_the_base_frame_whatever_the_camera_pose(seed, grid, height_of_plane):
    random = generator(seed)
    pose = camera_above_table(random)
    camera = calibrated(24, 36, pose)
    depth = depth_of_plane(height_of_plane, pose, camera)
    features, valid = make_source({"front": camera}, grid)({depth_key("front"): depth})
    assert valid.any()
    height = features[valid][:, 2]
    torch.testing.assert_close(height, torch.full_like(height, height_of_plane), atol=1e-4, rtol=0)
    assert features[valid][:, 5].max() < 2e-3  # spread of z
    in_camera, _ = make_source({"front": camera}, grid, base_frame=False)({depth_key("front"): depth})
    torch.testing.assert_close(in_camera[valid][:, 2], in_camera[valid][:, 2].abs())  # in front of the camera
    assert (in_camera[valid][:, 2] - height_of_plane).abs().min() > 0.1


@given(seed=seeds)
def test_moving_the_camera_leaves_points_where_they_are_in_the_base_frame_only(seed):
    random = generator(seed)
    scene = uniform(random, -0.1, 0.1, 12, 3).double()
    means = {True: [], False: []}
    poses = [camera_above_table(random), camera_above_table(random)]
    assume((poses[0][:3, 3] - poses[1][:3, 3]).norm() > 0.3)
    for pose in poses:
        camera = calibrated(300, 400, pose, focal=0.8)
        pixels, distance = project(scene, pose, camera)
        u, v = pixels.round().long().T
        assume(len(set(zip(u.tolist(), v.tolist(), strict=True))) == len(scene))  # no point hides another
        depth = torch.zeros(1, 1, 300, 400)
        depth[0, 0, v, u] = distance.float()
        for base_frame in means:
            source = make_source({"front": camera}, 1, base_frame=base_frame)
            means[base_frame].append(source({depth_key("front"): depth}).features[0, 0, 0, MEAN])
    # A pixel is 3 to 6 mm wide at these distances, and rounding to pixels averages out.
    torch.testing.assert_close(means[True][0], scene.mean(dim=0).float(), atol=4e-3, rtol=0)
    torch.testing.assert_close(means[True][0], means[True][1], atol=4e-3, rtol=0)
    assert (means[False][0] - means[False][1]).norm() > 0.01


@given(seed=seeds, quarter_turns=st.integers(1, 3))
def test_rolling_the_camera_moves_cells_and_not_their_points(seed, quarter_turns):
    """Turned about its optical axis by quarter turns, a camera sees the same pixels elsewhere: an exact comparison."""
    random = generator(seed)
    grid, side, pose = 3, 12, random_pose(random)
    camera = CameraCalibration([20.0, 20.0, 5.5, 5.5], [side, side], pose.tolist())
    turn = torch.eye(4, dtype=torch.float64)
    c, s = round(math.cos(quarter_turns * math.pi / 2)), round(math.sin(quarter_turns * math.pi / 2))
    turn[:2, :2] = torch.tensor([[c, -s], [s, c]])
    turned = CameraCalibration(camera.intrinsics, camera.size, (pose @ turn).tolist())
    depth = random_depth(random, 1, side, side)
    # x is right and y is down, so this turn is clockwise in the image, and its content turns counter-clockwise.
    seen_turned = depth.rot90(quarter_turns, dims=(2, 3))
    before = make_source({"front": camera}, grid)({depth_key("front"): depth})
    after = make_source({"front": turned}, grid)({depth_key("front"): seen_turned})
    cells = before.features[0, 0].unflatten(0, (grid, grid)).rot90(quarter_turns, dims=(0, 1)).flatten(0, 1)
    torch.testing.assert_close(after.features[0, 0], cells, atol=5e-3, rtol=0)


@given(seed=seeds)
def test_a_coarser_depth_image_of_the_same_camera_gives_the_same_points(seed):
    random = generator(seed)
    pose = camera_above_table(random)
    fine, coarse = calibrated(64, 96, pose), calibrated(32, 48, pose)
    coarse.intrinsics = fine.scaled_intrinsics(32, 48)
    source = make_source(
        {"front": fine}, 2, sizes={"front": (32, 48)}
    )  # calibrated for the fine image, fed the coarse one
    features, valid = source({depth_key("front"): depth_of_plane(0.0, pose, coarse)})
    expected, expected_valid = make_source({"front": fine}, 2)({depth_key("front"): depth_of_plane(0.0, pose, fine)})
    both = valid & expected_valid & (expected[..., FRACTION] > 0.99)
    torch.testing.assert_close(features[both][:, MEAN], expected[both][:, MEAN], atol=5e-3, rtol=0)


def test_units_and_layouts_agree():
    random = generator(0)
    camera = calibrated(12, 18, random_pose(random))
    millimetres = torch.randint(300, 3000, (2, 1, 12, 18), generator=random)
    in_metres = make_source({"front": camera}, 3)({depth_key("front"): millimetres.float() / 1000})
    for depth in (
        millimetres.to(torch.uint16),
        millimetres.permute(0, 2, 3, 1).to(torch.uint16),
        millimetres[:, 0].float(),
    ):
        in_millimetres = make_source({"front": camera}, 3, unit="mm")({depth_key("front"): depth})
        torch.testing.assert_close(in_millimetres.features, in_metres.features, atol=2e-3, rtol=0)
        assert torch.equal(in_millimetres.valid, in_metres.valid)


# --- what never gets in -------------------------------------------------------------------------------------------


@given(seed=seeds, grid=st.sampled_from([1, 2, 6]), bad=st.sampled_from([math.nan, math.inf, -math.inf, -1.0, 10.5]))
def test_what_was_not_measured_never_reaches_a_feature(seed, grid, bad):
    random = generator(seed)
    source = make_source({"front": calibrated(12, 18, random_pose(random))}, grid)
    depth = random_depth(random, 2, 12, 18)
    depth[:, :, :6, :9] = 0.0  # whole cells too
    expected = source({depth_key("front"): depth})
    features, valid = source({depth_key("front"): depth.masked_fill(depth == 0, bad)}, check=False)
    assert torch.equal(features, expected.features)
    assert torch.equal(valid, expected.valid)
    assert features.isfinite().all()


def test_an_observation_without_any_measurement_is_all_masked():
    source = make_source({"front": calibrated(12, 18, random_pose(generator(0)))}, 3).eval()
    for nothing in (0.0, math.nan, math.inf):
        features, valid = source({depth_key("front"): torch.full((2, 1, 12, 18), nothing)})
        assert not valid.any()
        assert features.eq(0).all()


# --- several cameras, moving cameras ------------------------------------------------------------------------------


def three_cameras(random: torch.Generator) -> dict[str, CameraCalibration]:
    sizes = {"left": (12, 18), "wrist": (9, 9), "right": (12, 18)}
    return {name: calibrated(*size, random_pose(random)) for name, size in sizes.items()}


@given(seed=seeds, missing=st.sampled_from(["left", "wrist", "right"]))
def test_a_missing_camera_is_masked_and_the_others_are_unchanged(seed, missing):
    random = generator(seed)
    cameras = three_cameras(random)
    source = make_source(cameras, 3)
    observation = random_observation(random, source)
    expected = source(observation)
    assert expected.features.shape[:3] == (2, 3, 9)
    for view, name in enumerate(cameras):  # cameras stand in the order they were named in
        alone = make_source({name: cameras[name]}, 3)(observation)
        assert torch.equal(expected.features[:, view], alone.features[:, 0])
    del observation[depth_key(missing)]
    assert source.missing_cameras(observation) == [missing]
    features, valid = source(observation)
    for view, name in enumerate(cameras):
        if name == missing:
            assert not valid[:, view].any()
            assert features[:, view].eq(0).all()
        else:
            assert torch.equal(features[:, view], expected.features[:, view])
            assert torch.equal(valid[:, view], expected.valid[:, view])


def test_no_camera_at_all_is_refused():
    source = make_source(three_cameras(generator(0)), 3)
    with pytest.raises(ValueError, match=r"No depth in the batch.*left_depth.*wrist_depth.*right_depth"):
        source({"observation.state": torch.zeros(1, 4)})


@given(seed=seeds)
def test_a_pose_in_the_frame_overrides_the_calibration(seed):
    random = generator(seed)
    filed, poses = random_pose(random), torch.stack([random_pose(random), random_pose(random)])
    depth = random_depth(random, 2, 12, 18)
    source = make_source({"front": calibrated(12, 18, filed)}, 3)
    moving = source({depth_key("front"): depth, extrinsics_key("front"): poses.float()})
    for row in range(2):
        fixed = make_source({"front": calibrated(12, 18, poses[row])}, 3)
        expected = fixed({depth_key("front"): depth[row : row + 1]})
        torch.testing.assert_close(moving.features[row], expected.features[0], atol=5e-3, rtol=0)
    assert not torch.allclose(moving.features, source({depth_key("front"): depth}).features, atol=0.05)


def test_the_camera_frame_needs_no_pose_and_ignores_one():
    random = generator(0)
    depth = random_depth(random, 1, 12, 18)
    source = make_source({"front": calibrated(12, 18)}, 3, base_frame=False)
    with_pose = source({depth_key("front"): depth, extrinsics_key("front"): random_pose(random)[None]})
    assert torch.equal(source({depth_key("front"): depth}).features, with_pose.features)


# --- what is refused ----------------------------------------------------------------------------------------------


def one_camera(**changes):
    return make_source({"front": calibrated(12, 18, random_pose(generator(0)))}, 3, **changes)


@pytest.mark.parametrize("shape", [(1, 1, 18, 12), (1, 1, 24, 36), (1, 3, 12, 18)])
def test_a_wrong_depth_size_is_refused(shape):
    with pytest.raises(ValueError, match=r"front_depth has shape .*expects depth of 12 x 18 pixels"):
        one_camera()({depth_key("front"): torch.ones(shape)}, check=False)


def test_a_wrong_depth_dtype_is_refused():
    with pytest.raises(ValueError, match=r"front_depth has dtype torch.uint8"):
        one_camera()({depth_key("front"): torch.ones(1, 1, 12, 18, dtype=torch.uint8)}, check=False)


def test_all_nan_is_refused_in_training_only():
    batch = {depth_key("front"): torch.ones(2, 1, 12, 18)}
    batch[depth_key("front")][1] = math.nan
    with pytest.raises(ValueError, match=r"front_depth is all NaN in sample 1"):
        one_camera().train()(batch)
    assert one_camera().eval()(batch).valid.any(dim=-1).tolist() == [[True], [False]]


@pytest.mark.parametrize(("declared", "distance"), [("mm", 0.8), ("m", 800.0)])
@pytest.mark.parametrize("training", [True, False])
def test_a_wrong_unit_is_refused(declared, distance, training):
    with pytest.raises(ValueError, match=rf"front_depth has a median distance .* read as '{declared}'"):
        one_camera(unit=declared).train(training)({depth_key("front"): torch.full((1, 1, 12, 18), distance)})


def test_a_camera_without_extrinsics_is_missing_from_the_base_frame_only():
    batch = {depth_key("wrist"): torch.ones(1, 1, 12, 18)}
    source = make_source({"wrist": calibrated(12, 18)}, 3)
    assert source.missing_cameras(batch) == ["wrist"]
    assert source.missing_cameras(batch | {extrinsics_key("wrist"): torch.eye(4)[None]}) == []
    assert make_source({"wrist": calibrated(12, 18)}, 3, base_frame=False).missing_cameras(batch) == []


@pytest.mark.parametrize("kind", ["scaled", "reflected", "NaN"])
def test_a_pose_in_the_frame_that_is_no_rigid_transform_is_refused(kind):
    pose = random_pose(generator(1))[None].repeat(2, 1, 1).float()
    if kind == "scaled":
        pose[1, :3, :3] *= 1.05
    elif kind == "reflected":
        pose[1, :3, 1] *= -1
    else:
        pose[1, 0, 0] = math.nan
    batch = {depth_key("front"): torch.ones(2, 1, 12, 18), extrinsics_key("front"): pose}
    with pytest.raises(ValueError, match=r"calibration.front.extrinsics must be a rigid transform"):
        one_camera()(batch)


# --- names and forms in which depth and poses arrive ---------------------------------------------------------------


class MatrixProducts(TorchDispatchMode):
    """Counts what `allow_tf32` rounds: matrix products and convolutions."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.name().split("::")[1].split(".")[0]
        if name in ("mm", "bmm", "addmm", "baddbmm", "dot", "mv", "convolution", "_scaled_mm"):
            self.found.append(name)
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("moving", [True, False])
def test_points_come_from_no_product_that_tf32_may_round(moving):
    """lerobot-train sets `allow_tf32`, which rounds the factors of matrix products on a GPU: up to 0.9 mm at 1 m."""
    random = generator(0)
    batch = {depth_key("front"): random_depth(random, 2, 12, 18)}
    if moving:
        batch[extrinsics_key("front")] = torch.stack([random_pose(random).float() for _ in range(2)])
    with MatrixProducts() as products:
        one_camera()(batch, check=False)
    assert products.found == []
    with MatrixProducts() as products:
        torch.einsum("ij,bjk->bik", torch.eye(3), torch.ones(2, 3, 5))
    assert products.found, "this counter finds none"


def test_a_pose_of_16_numbers_is_a_pose_of_4_x_4():
    random = generator(4)
    poses = torch.stack([random_pose(random) for _ in range(2)]).float()
    depth = random_depth(random, 2, 12, 18)
    source = make_source({"front": calibrated(12, 18)}, 3)
    expected = source({depth_key("front"): depth, extrinsics_key("front"): poses})
    found = source({depth_key("front"): depth, extrinsics_key("front"): poses.flatten(1)})
    assert torch.equal(found.features, expected.features)
    for once in (poses[0], poses[0].flatten()):  # one pose for the whole batch
        same = source({depth_key("front"): depth, extrinsics_key("front"): once})
        assert torch.equal(same.features[0], expected.features[0])
    with pytest.raises(ValueError, match=r"must be a rigid transform"):  # column by column
        source({depth_key("front"): depth, extrinsics_key("front"): poses.mT.flatten(1)})
    for shape in ((2, 12), (2, 3, 4), (2, 7)):
        with pytest.raises(ValueError, match=r"16 numbers row by row or as 4 x 4, got shape"):
            source({depth_key("front"): depth, extrinsics_key("front"): torch.zeros(shape)})


def test_depth_is_found_under_its_recorded_key_and_under_lerobots():
    depth = random_depth(generator(0), 2, 12, 18)
    expected = one_camera()({depth_key("front"): depth})
    source = one_camera(depth_keys={"front": "observation.depth.front"})
    for key in ("observation.depth.front", depth_key("front")):
        assert source.missing_cameras({key: depth}) == []
        assert torch.equal(source({key: depth}).features, expected.features)
    both = {"observation.depth.front": depth, depth_key("front"): 2 * depth}
    assert torch.equal(source(both).features, expected.features)
    assert source.missing_cameras({"observation.state": depth}) == ["front"]
    assert "expected observation.depth.front " in source.missing_message(["front"])
