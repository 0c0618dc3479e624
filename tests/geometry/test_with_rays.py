"""Depth Anything 3's features beside camera rays."""

import pytest
import torch

from lerobot_policy_pi05_geometry.geometry import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.calibration import Rig
from lerobot_policy_pi05_geometry.geometry.placed_camera import PlacedCamera
from lerobot_policy_pi05_geometry.geometry.rays import FEATURE_DIM, RaySource
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import WRIST_POSE, chunk_of, make_batch, make_calibration, make_policy, without
from tests.geometry.da3.tiny import write_tiny


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("hub") / "DA3-TINY" / "model.safetensors").parent


def make_da3(encoder, tokens: str, **changes) -> PI05GeometryPolicy:
    settings = {"geometry_source": "da3", "da3_encoder": str(encoder), "da3_image_size": 42}
    return make_policy(geometry_tokens=tokens, **{**settings, **changes})


def test_features_are_those_of_both(encoder) -> None:
    plain, both, batch = make_da3(encoder, "statistics"), make_da3(encoder, "rays"), make_batch(2)
    source = both.geometry.source
    found, seen = source(batch), plain.geometry.source(batch)
    assert source.feature_dim == plain.geometry.source.feature_dim + FEATURE_DIM
    assert torch.equal(found.features[..., :-FEATURE_DIM], seen.features)
    assert torch.equal(found.valid, seen.valid)
    sizes = {"front": (30, 40), "wrist": (28, 28)}
    placed = [PlacedCamera(camera, {0: Rig(make_calibration())}, size) for camera, size in sizes.items()]
    rays = RaySource(placed, 3, sizes)(batch)
    assert torch.equal(found.features[..., -FEATURE_DIM:], rays.features)


def test_a_policy_with_rays_follows_the_camera(encoder, tmp_path) -> None:
    """It trains every new parameter, is saved and loaded bit for bit, and is told where the camera stands."""
    policy, batch = make_da3(encoder, "rays"), make_batch(2)
    policy.train().forward(batch)[0].backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in policy.new_parameters().values())
    policy.save_pretrained(tmp_path)
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path)
    assert torch.equal(chunk_of(loaded, batch), chunk_of(policy.eval(), batch))
    moved = batch | {WRIST_POSE: batch[WRIST_POSE].clone()}
    moved[WRIST_POSE][:, 0, 3] += 0.5
    assert (chunk_of(policy, moved) - chunk_of(policy, batch)).abs().max() > 1e-4
    plain = make_da3(encoder, "statistics")
    assert torch.equal(chunk_of(plain, moved), chunk_of(plain, batch))


def test_a_missing_pose_is_an_error_in_training_and_zeros_afterwards(encoder) -> None:
    policy, batch = make_da3(encoder, "rays"), without(make_batch(2), WRIST_POSE)
    found = policy.geometry.source(batch)
    assert (found.features[:, 1, :, -FEATURE_DIM:] == 0).all()
    assert found.valid.all()
    with pytest.raises(ValueError, match="has no pose of camera"):
        policy.train().forward(batch)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"calibration": {"front": CameraCalibration([30.0, 30.0, 19.5, 14.5], [40, 30])}}, "has no (in|ex)trinsics"),
        ({"geometry_source": "rgbd"}, "geometry_tokens=rays belongs to geometry_source=da3 or features"),
        ({"geometry_frame": "camera"}, "leave geometry_frame=base"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(changes, said, encoder) -> None:
    with pytest.raises(ValueError, match=said):
        make_da3(encoder, "rays", **changes)


def test_points_belong_to_depth(encoder) -> None:
    with pytest.raises(ValueError, match="geometry_tokens=points belongs to geometry_source=rgbd"):
        make_da3(encoder, "points")
