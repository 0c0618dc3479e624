"""What a depth sensor's faults do, and what they leave alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.sim.sensor import SENSORS, DepthSensor

seeds = st.integers(0, 2**32 - 1)


def scene(size: int = 64) -> np.ndarray:
    """A wall 2 m away behind a box 1 m away, (size, size) metres."""
    depth = np.full((size, size), 2.0)
    depth[size // 4 : size // 2, size // 4 : size // 2] = 1.0
    return depth


def test_an_ideal_sensor_measures_what_is_there():
    assert (SENSORS["ideal"].measure(scene(), np.random.default_rng(0)) == scene()).all()


def test_a_sensor_that_is_off_measures_nothing():
    assert not SENSORS["off"].measure(scene(), np.random.default_rng(0)).any()


@given(seeds)
def test_noise_grows_with_distance_and_holes_lie_at_edges(seed):
    depth = scene()
    measured = SENSORS["noisy"].measure(depth, np.random.default_rng(seed))
    seen = measured > 0
    inner_box, wall = (slice(20, 28),) * 2, (slice(40, 64), slice(0, 64))
    near = (measured - depth)[inner_box][seen[inner_box]]
    far = (measured - depth)[wall][seen[wall]]
    if len(near) > 20:
        assert near.std() < far.std() < 0.012
    assert abs(far.mean()) < 0.001
    edge = np.zeros_like(seen)
    edge[15:17, 16:32] = edge[31:33, 16:32] = edge[16:32, 15:17] = edge[16:32, 31:33] = True
    assert seen[edge].mean() < 0.7 < seen[~edge].mean()
    assert 0.85 < seen.mean() < 0.97


@given(seeds, st.sampled_from(["calibration-1", "calibration-2", "calibration-5"]))
def test_a_wrong_calibration_is_wrong_by_as_much_as_it_says(seed, name):
    error = SENSORS[name].draw_pose_error(np.random.default_rng(seed))
    size = int(name.rsplit("-", 1)[1])
    angle = np.degrees(np.arccos((np.trace(error[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(size, abs=1e-6)
    assert np.linalg.norm(error[:3, 3]) == pytest.approx(size / 100)
    assert np.allclose(error[:3, :3] @ error[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(error[:3, :3]) == pytest.approx(1.0)
    assert (error[3] == [0, 0, 0, 1]).all()


@given(seeds)
def test_a_right_calibration_is_exactly_right(seed):
    assert (DepthSensor().draw_pose_error(np.random.default_rng(seed)) == np.eye(4)).all()
