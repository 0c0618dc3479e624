"""Training augmentation of depth: what it changes, what it never touches, and that it depends on the sample's key alone."""

import copy

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from lerobot_policy_pi05_geometry.geometry.depth_augmentation import DepthAugmentation, augment_depth, jittered
from lerobot_policy_pi05_geometry.geometry.keys import AUGMENTATION_KEY
from lerobot_policy_pi05_geometry.geometry.point_map import transform, unproject
from lerobot_policy_pi05_geometry.geometry.rigid import check_rigid
from tests.entry_points import make_batch, make_config, make_policy
from tests.geometry.scenes import (
    calibrated,
    generator,
    make_source,
    random_depth,
    random_observation,
    random_pose,
    seeds,
)

EVERYTHING = DepthAugmentation(noise=0.01, holes=0.2, scale=0.03, shift=0.01, turn=1.0)
FAR = 10.0


def keys(seed: int, count: int) -> Tensor:
    return torch.randint(1 << 62, (count,), generator=generator(seed))


def augmented(settings: DepthAugmentation, depth: Tensor, seed: int = 0, camera: int = 0) -> tuple[Tensor, Tensor]:
    return augment_depth(settings, depth, depth > 0, keys(seed, len(depth)), camera, FAR)


def sizes(**changes) -> DepthAugmentation:
    return DepthAugmentation(**changes)


@given(seed=seeds, height=st.integers(1, 30), width=st.integers(1, 30))
def test_only_measured_pixels_change_and_holes_stay_holes(seed, height, width):
    depth = random_depth(generator(seed), 3, height, width)
    found, valid = augmented(EVERYTHING, depth, seed)
    assert not (valid & (depth == 0)).any()
    assert found[~valid].eq(0).all()
    assert (found[valid] > 0).all()
    noisy, kept = augmented(sizes(noise=1e-4), depth, seed)
    assert torch.equal(kept, depth > 0)
    assert (noisy - depth)[depth == 0].eq(0).all()


@given(seed=seeds)
def test_a_scale_error_scales_points_about_the_camera(seed):
    random = generator(seed)
    depth, pose, numbers = random_depth(random, 2, 6, 8), random_pose(random), torch.tensor([9.0, 9.5, 3.6, 2.9])
    found, valid = augmented(sizes(scale=0.05), depth, seed)
    before, after = (transform(pose, unproject(d, numbers)) - pose[:3, 3].reshape(1, 3, 1, 1) for d in (depth, found))
    for row in range(2):
        pixels = valid[row, 0]
        factor = (found / depth)[row, 0][pixels][0]
        assert abs(factor - 1) <= 0.15 + 1e-6
        torch.testing.assert_close(after[row][:, pixels], factor * before[row][:, pixels], atol=2e-5, rtol=0)


@given(seed=seeds)
def test_jitter_is_rigid_and_leaves_the_shape_of_what_is_seen(seed):
    random = generator(seed)
    poses = torch.stack([random_pose(random) for _ in range(3)]).float()
    numbers = keys(seed, 3)
    found = jittered(EVERYTHING, poses, numbers, 0)
    check_rigid(found, "the jittered pose")
    assert (found[:, :3, 3] - poses[:, :3, 3]).norm(dim=1).max() <= 3 * 0.01 * 3**0.5 + 1e-5
    turn = (poses[:, :3, :3].mT @ found[:, :3, :3]).double()
    angles = ((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1).acos().rad2deg()
    assert angles.max() <= 3 * 3**0.5 + 0.1
    assert (found - poses).abs().amax(dim=(1, 2)).min() > 0
    points = torch.rand(3, 3, 4, 4, generator=random)
    distances = [torch.cdist(p.flatten(2).mT, p.flatten(2).mT) for p in (points, transform(found, points))]
    torch.testing.assert_close(distances[1], distances[0], atol=1e-5, rtol=0)
    assert torch.equal(jittered(EVERYTHING, poses[0], numbers, 0)[0], found[0])  # one pose for the whole batch


def test_sizes_are_as_told():
    count = 400
    depth = torch.tensor([0.5, 1.0, 2.0]).repeat(40, 80)[None, None].repeat(count, 1, 1, 1)
    noise = augmented(sizes(noise=0.004), depth)[0] - depth
    for metres in (0.5, 1.0, 2.0):  # a stereo camera's noise grows with the square of the distance
        assert noise[depth == metres].std() == pytest.approx(0.004 * metres**2, rel=0.02)
        assert noise[depth == metres].mean().abs() < 1e-4 * metres**2
    assert (augmented(sizes(scale=0.02), depth)[0] / depth)[:, 0, 0, 0].std() == pytest.approx(0.02, rel=0.15)
    holes = ~augmented(sizes(holes=0.1), depth)[1]
    assert holes.float().mean() == pytest.approx(0.1, rel=0.05)
    assert (holes[..., 1:] == holes[..., :-1]).float().mean() > 0.95  # in patches
    poses = jittered(sizes(shift=0.01, turn=2.0), torch.eye(4), keys(0, count), 0)
    assert poses[:, :3, 3].std() == pytest.approx(0.01, rel=0.15)
    assert poses[:, 0, 1].std().rad2deg() == pytest.approx(2.0, rel=0.15)


def test_a_pixels_noise_is_independent_of_every_others():
    """Neighbouring pixels, samples whose keys differ by one bit, cameras and kinds of draws share nothing."""
    ones = torch.ones(4, 1, 60, 80)
    numbers = torch.tensor([5, 4, 5 + (1 << 32), 5 + (1 << 61)])
    noise = [augment_depth(sizes(noise=0.01), ones, ones > 0, numbers, camera, FAR)[0] - 1 for camera in (0, 1)]
    rows = torch.cat([n.flatten(1) for n in noise])
    shifted = torch.stack([rows[0].roll(1), rows[0].roll(80)])
    correlation = torch.corrcoef(torch.cat([rows, shifted])) - torch.eye(10)
    assert correlation.abs().max() < 0.06


def test_a_draw_depends_on_key_and_camera_alone():
    depth = random_depth(generator(0), 5, 20, 30)
    numbers = keys(1, 5)
    together = augment_depth(EVERYTHING, depth, depth > 0, numbers, 0, FAR)
    for rows in (slice(0, 2), slice(2, 5), slice(3, 4)):
        alone = augment_depth(EVERYTHING, depth[rows], depth[rows] > 0, numbers[rows], 0, FAR)
        assert all(torch.equal(a, t[rows]) for a, t in zip(alone, together, strict=True))
    other = augment_depth(EVERYTHING, depth, depth > 0, numbers, 1, FAR)
    assert not torch.equal(other[0], together[0])


# --- in the source and in the policy ----------------------------------------------------------------------------------


@pytest.mark.parametrize("tokens", ["statistics", "points"])
@pytest.mark.parametrize("what", ["noise", "holes", "scale", "shift", "turn"])
def test_a_source_augments_training_batches_alone(what, tokens):
    cameras = {"front": calibrated(12, 16, random_pose(generator(0))), "wrist": calibrated(9, 9)}
    cameras["wrist"].extrinsics = random_pose(generator(1)).tolist()
    settings = {"grid": 2, "as_points": tokens == "points"}
    source = make_source(cameras, **settings, augmentation=sizes(**{what: 0.1}))
    plain = make_source(cameras, **settings)
    batch = random_observation(generator(2), source, 3)
    keyed = batch | {AUGMENTATION_KEY: keys(0, 3)}
    expected = plain.train()(batch).features
    assert not torch.equal(source.train()(keyed).features, expected)
    assert torch.equal(source.train()(batch).features, expected)
    assert torch.equal(source.eval()(keyed).features, expected)
    assert torch.equal(plain.train()(keyed).features, expected)  # off


QUIET = {"geometry_dropout": 0.0, "image_dropout": 0.0}


def test_in_a_policy_off_changes_nothing_and_evaluation_never_changes():
    policy, off = make_policy(**QUIET, depth_augmentation=EVERYTHING), make_policy(**QUIET)
    batch = make_batch(4)
    assert torch.equal(policy.eval().forward(batch)[0], off.eval().forward(batch)[0])
    assert torch.equal(
        policy.predict_action_chunk(batch, noise=torch.zeros(4, 6, 8)[:, : policy.config.chunk_size]),
        off.predict_action_chunk(batch, noise=torch.zeros(4, 6, 8)[:, : policy.config.chunk_size]),
    )
    assert not torch.equal(policy.train().forward(batch)[0], off.train().forward(batch)[0])


def test_a_resumed_run_and_micro_batches_see_the_same():
    policy = make_policy(**QUIET, depth_augmentation=EVERYTHING).train()
    resumed, parts = copy.deepcopy(policy), copy.deepcopy(policy)
    parts.config.micro_batch_size = 2
    batch = make_batch(5)
    policy.forward(batch)
    policy.update()
    second = policy.forward(batch, "none")[0]
    for other in (resumed, parts):
        torch.rand(3)  # what the global generator did meanwhile has no effect
        other.progress.step.add_(1)
        torch.testing.assert_close(other.forward(batch, "none")[0], second, atol=1e-6, rtol=1e-6)
    shuffled = {
        k: v[[3, 1, 0, 4, 2]] if isinstance(v, Tensor) else [v[i] for i in (3, 1, 0, 4, 2)] for k, v in batch.items()
    }
    torch.testing.assert_close(resumed.forward(shuffled, "none")[0], second[[3, 1, 0, 4, 2]], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"depth_augmentation": sizes(noise=-0.1)}, r"depth_augmentation.noise must be 0 or more"),
        ({"depth_augmentation": sizes(turn=float("nan"))}, r"depth_augmentation.turn must be 0 or more"),
        ({"depth_augmentation": sizes(holes=1.0)}, r"holes is a share"),
        ({"depth_augmentation": sizes(scale=1.0)}, r"scale is a relative error"),
        (
            {"depth_augmentation": sizes(shift=0.01), "geometry_frame": "camera"},
            r"no effect with geometry_frame=camera",
        ),
        *(
            (
                {"depth_augmentation": sizes(holes=0.1), "geometry_source": source},
                f"geometry_source={source} does not have",
            )
            for source in ("none", "da3", "features", "rays", "random")
        ),
    ],
)
def test_sizes_that_cannot_be_or_have_no_effect_are_refused(settings, said):
    with pytest.raises(ValueError, match=said) as caught:
        make_config(**settings)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")
