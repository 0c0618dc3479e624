"""Cameras on a moving arm, raw counts, codec bounds and several rigs: points land where the scene is."""

import json
import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given

from lerobot_policy_pi05_geometry.geometry.calibration import Rig
from lerobot_policy_pi05_geometry.geometry.camera import Mount
from lerobot_policy_pi05_geometry.geometry.dataset_depth import check_depth_scale, codec_bounds
from lerobot_policy_pi05_geometry.geometry.keys import RAW_STATE, RIG, depth_key
from lerobot_policy_pi05_geometry.geometry.kinematics import ForwardKinematics
from lerobot_policy_pi05_geometry.geometry.placed_camera import PlacedCamera
from lerobot_policy_pi05_geometry.geometry.rgbd import RgbdSource
from tests.geometry.arms import random_state, so101_like
from tests.geometry.scenes import calibrated, generator, make_source, random_depth, random_pose, seeds

SIZE = (9, 12)
DEPTH = depth_key("wrist")


def on_gripper(seed: int):
    """A camera on the gripper of an SO-101."""
    mount = Mount("arm", "gripper", random_pose(generator(seed), 0.1).tolist())
    return replace(calibrated(*SIZE), mount=mount)


@given(seed=seeds)
def test_a_wrist_cameras_pose_is_forward_kinematics_times_its_mount(seed):
    random = generator(seed)
    arm, camera = so101_like(), on_gripper(seed)
    source = make_source({"wrist": camera}, 2, arms={"arm": arm})
    state = random_state(random, arm, 3, width=6)
    depth = random_depth(random, 3, *SIZE)
    found = source({DEPTH: depth, RAW_STATE: state})
    for row in range(3):
        link = ForwardKinematics(arm, ["gripper"])(state[row : row + 1].double())[0, 0]
        pose = link @ torch.tensor(camera.mount.link_T_camera, dtype=torch.float64)
        fixed = make_source({"wrist": replace(camera, mount=None, extrinsics=pose.tolist())}, 2)
        expected = fixed({DEPTH: depth[row : row + 1]})
        assert torch.equal(found.valid[row : row + 1], expected.valid)
        # The first seven features are metres and a share; the others are sines of up to 100 radians per metre.
        assert (found.features[row : row + 1, ..., :7] - expected.features[..., :7]).abs().max() <= 1e-5


def test_without_the_raw_state_a_wrist_camera_is_missing():
    source = make_source({"wrist": on_gripper(0)}, 2, arms={"arm": so101_like()})
    batch = {DEPTH: random_depth(generator(0), 1, *SIZE), "observation.state": torch.zeros(1, 6)}
    assert source.missing_cameras(batch) == ["wrist"]
    assert RAW_STATE in source.missing_message(["wrist"])
    assert source.missing_cameras(batch | {RAW_STATE: torch.zeros(1, 6)}) == []


@pytest.mark.parametrize(("scale", "factor"), [(None, 1.0), (1e-3, 1.0), (1e-4, 0.1), (2.5e-4, 0.25)])
def test_counts_are_scaled_to_metres(scale, factor):
    """LeRobot calls every count a millimetre; a D405's is a tenth of one."""
    true = random_depth(generator(1), 2, *SIZE) * 0.5 + 0.2
    camera = replace(calibrated(*SIZE, random_pose(generator(2))), depth_scale=scale)
    source = make_source({"wrist": camera}, 2, unit="mm")
    counts = (true / factor * 1000).round()
    found = source({DEPTH: counts}, check=True)
    expected = make_source({"wrist": replace(camera, depth_scale=None)}, 2, unit="m")({DEPTH: counts / 1000 * factor})
    torch.testing.assert_close(found.features[..., :7], expected.features[..., :7], atol=5e-6, rtol=0)


@pytest.mark.parametrize("bounds", [(0.1, 3.0), (0.01, 10.0), (0.3, 1.0)])
def test_what_the_codec_cannot_say_is_not_measured(bounds):
    """As LeRobot decodes it: a hole is depth_min, all that is farther depth_max. A robot's raw depth has the same "
    "pixels valid."""
    from lerobot.datasets.depth_utils import dequantize_depth, quantize_depth

    low, high = bounds
    raw = (1000 * torch.linspace(0.0, 6.0, 9 * 12)).round().reshape(1, 1, *SIZE)
    raw[raw.ne(0) & raw.sub(1000 * low).abs().le(15)] = 0  # within a quantum of a bound, decoding decides
    raw[raw.sub(1000 * high).abs().le(15)] = 6000
    codes = quantize_depth(raw[0, 0].numpy().astype("uint16"), low, high, video_backend=None)
    decoded = dequantize_depth(torch.from_numpy(codes.astype("int32"))[None], low, high)[None]
    camera = {"wrist": calibrated(*SIZE, random_pose(generator(0)))}
    source = make_source(camera, 3, unit="mm", bounds={"wrist": bounds}, max_depth=20.0)
    trained, acting = source({DEPTH: decoded}), source({DEPTH: raw})
    inside = ((raw > 1000 * low) & (raw < 1000 * high)).float().mean()
    assert torch.equal(trained.valid, acting.valid)
    share = trained.features[0, 0, :, 6].mean()
    assert abs(share - inside) < 1e-5
    assert abs(acting.features[0, 0, :, 6].mean() - inside) < 1e-5


def features(dtype: str = "video", **info) -> dict:
    return {DEPTH: {"dtype": dtype, "shape": (9, 12, 1), "info": {"is_depth_map": True, **info}}}


def test_codec_bounds_are_the_datasets():
    given = {"video.depth_min": 0.1, "video.depth_max": 3.0}
    assert codec_bounds(features(**given), ["wrist"], {}) == {"wrist": [0.1, 3.0]}
    assert codec_bounds(features(), ["wrist"], {}) == {"wrist": [0.01, 10.0]}  # LeRobot's defaults
    assert codec_bounds(features("image", **given), ["wrist"], {}) == {}
    with pytest.raises(ValueError, match=r"wrist_depth has lost video.depth_min and video.depth_max.*merge again"):
        codec_bounds(features(**{"video.depth_min": None, "video.depth_max": None}), ["wrist"], {})


@pytest.mark.parametrize("robot", ["so_follower", "so101_follower", "koch_follower", "a_new_arm", "metaworld_sawyer"])
def test_raw_counts_without_a_scale_are_refused(robot, caplog):
    meta = SimpleNamespace(features=features(depth_unit="mm"), robot_type=robot)
    rigs = {0: Rig({"wrist": calibrated(*SIZE)})}
    if "follower" in robot:
        with pytest.raises(ValueError, match=r"no depth_scale of camera\(s\) wrist.*pi05-geometry calibrate camera"):
            check_depth_scale(rigs, meta, ["wrist"], {})
    else:
        check_depth_scale(rigs, meta, ["wrist"], {})
        assert len([r for r in caplog.records if r.levelno == logging.WARNING]) == (robot == "a_new_arm")
    caplog.clear()
    check_depth_scale({0: Rig({"wrist": replace(calibrated(*SIZE), depth_scale=1e-4)})}, meta, ["wrist"], {})
    metres = SimpleNamespace(features=features(depth_unit="m"), robot_type=robot)
    check_depth_scale(rigs, metres, ["wrist"], {})
    assert not caplog.records


def test_each_frame_gets_its_own_rigs_calibration():
    random, arm = generator(5), so101_like()
    other = so101_like()
    other.joints[1].offset = 0.4
    mounted = on_gripper(1)
    rigs = {
        2: Rig({"wrist": replace(mounted, depth_scale=1e-4)}, {"arm": arm}),
        5: Rig({"wrist": replace(mounted, intrinsics=[20.0, 21.0, 5.0, 4.0])}, {"arm": other}),
        7: Rig({"wrist": replace(mounted, mount=None, extrinsics=random_pose(random).tolist())}),
    }
    ids = [7, 2, 5, 2]
    batch = {
        DEPTH: 1000 * random_depth(random, 4, *SIZE),
        RAW_STATE: random_state(random, arm, 4, width=6),
        RIG: torch.tensor(ids)[:, None],
    }

    def source(rigs: dict[int, Rig], only: int | None = None) -> RgbdSource:
        placed = PlacedCamera("wrist", rigs, SIZE, only)
        return RgbdSource([placed], 2, {"wrist": SIZE}, base_frame=True, unit="mm", max_depth=10.0)

    merged = source(rigs)(batch)
    for row, number in enumerate(ids):
        single = {key: value[row : row + 1] for key, value in batch.items() if key != RIG}
        alone = source({0: rigs[number]})(single)
        torch.testing.assert_close(merged.features[row : row + 1], alone.features, atol=1e-4, rtol=0)
        chosen = source(rigs, only=number)(single)  # as a robot acts, which reports no rig
        torch.testing.assert_close(chosen.features, alone.features, atol=1e-4, rtol=0)
    with pytest.raises(ValueError, match=r"several rigs \(2, 5, 7\).*--policy.rig"):
        source(rigs)({key: value for key, value in batch.items() if key != RIG})
    with pytest.raises(ValueError, match=r"rig has 3, but the calibration has the rigs 2, 5, 7"):
        source(rigs)(batch | {RIG: torch.tensor([2, 3, 5, 7])})


def test_a_calibration_survives_as_json():
    from lerobot_policy_pi05_geometry.geometry.calibration import calibration_content, parse_calibration

    rig = Rig({"wrist": on_gripper(0)}, {"arm": so101_like()})
    assert parse_calibration(json.loads(json.dumps(calibration_content(rig))), "here").cameras == rig.cameras
