"""The random control: as many tokens as a depth camera's, and nothing in them."""

import torch

from lerobot_policy_pi05_geometry.geometry.random_tokens import RandomSource
from tests.geometry.scenes import calibrated, generator, make_source, random_observation, random_pose

CAMERAS = ("left", "right")


def observation(seed: int, batch: int = 2) -> dict[str, torch.Tensor]:
    source = make_source({camera: calibrated(12, 18) for camera in CAMERAS}, 3)
    return random_observation(generator(seed), source, batch)


def test_features_are_the_same_for_every_observation_and_every_run():
    torch.manual_seed(1)
    first = RandomSource(CAMERAS, 3)(observation(0))
    torch.manual_seed(2)
    again = RandomSource(CAMERAS, 3)(observation(1))
    assert torch.equal(first.features, again.features)
    assert torch.equal(first.features[0], first.features[1])
    assert first.valid.all()


def test_features_are_the_same_where_modules_are_built_on_another_device():
    with torch.device("meta"):
        source = RandomSource(CAMERAS, 3)
    assert torch.equal(source(observation(0)).features, RandomSource(CAMERAS, 3)(observation(0)).features)


def test_features_are_standard_normal_and_differ_between_cells():
    features = RandomSource(CAMERAS, 8)(observation(0)).features[0].flatten(0, 1)
    assert features.mean().abs() < 0.05
    assert (features.std() - 1).abs() < 0.05
    assert len(features.unique(dim=0)) == 2 * 8 * 8


def test_they_have_the_shape_of_a_depth_cameras():
    calibration = {camera: calibrated(12, 18, random_pose(generator(0))) for camera in CAMERAS}
    depth, control = make_source(calibration, 3), RandomSource(CAMERAS, 3)
    assert control(observation(0)).features.shape == depth(observation(0)).features.shape
    assert control.num_tokens == depth.num_tokens == 18
    assert control.feature_dim == depth.feature_dim


def test_no_depth_is_needed():
    control = RandomSource(CAMERAS, 3)
    batch = {"observation.state": torch.zeros(5, 4), "action": torch.zeros(5, 2)}
    assert control.missing_cameras(batch) == []
    assert control(batch).features.shape == (5, 2, 9, 55)


def test_the_batch_size_is_not_taken_from_a_pose_without_a_batch():
    batch = {"observation.calibration.left.extrinsics": torch.eye(4), "observation.state": torch.zeros(1, 4)}
    assert RandomSource(CAMERAS, 3)(batch).features.shape[0] == 1


def test_nothing_is_trained_or_saved():
    control = RandomSource(CAMERAS, 3)
    assert not list(control.parameters())
    assert not control.state_dict()
