"""What a calibration makes of a frame: points where the scene is, the arm's links, and the cameras."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_policy_pi05_geometry.geometry.calibration import Calibration, Rig
from lerobot_policy_pi05_geometry.geometry.camera import Mount
from lerobot_policy_pi05_geometry.geometry.keys import RIG, depth_key, extrinsics_key
from lerobot_policy_pi05_geometry.geometry.kinematics import ForwardKinematics
from lerobot_policy_pi05_geometry.inspect.inspection import scene_of_policy
from lerobot_policy_pi05_geometry.inspect.scene import Scene, log_to_rerun, scene_figure, scene_of
from tests.entry_points import make_config, make_observation, make_policy
from tests.geometry.arms import so101_like
from tests.geometry.scenes import calibrated, depth_of_plane, looking_at
from tests.serving.running import POSE, make_rigs

SIZE = (12, 16)
FLOOR = -0.3


def above(x: float, y: float) -> torch.Tensor:
    """A camera that looks down at the floor."""
    return looking_at(torch.tensor([x, y, 0.5]), torch.tensor([0.0, -0.1, FLOOR]))


def frame() -> tuple[dict[str, torch.Tensor], Rig]:
    """A floor that a fixed camera, one on the gripper and one whose pose comes with the frame see, and a camera without depth."""
    arm, state = so101_like(), torch.tensor([[5.0, -10.0, 20.0, 0.0, 15.0, 0.0]])
    poses = {"front": above(0.4, 0.3), "wrist": above(0.1, -0.4), "moved": above(-0.3, 0.2), "webcam": above(0.2, 0.6)}
    link = ForwardKinematics(arm, ["gripper"])(state.double())[0, 0]
    cameras = {name: calibrated(*SIZE) for name in poses}
    cameras["front"] = replace(cameras["front"], extrinsics=poses["front"].tolist())
    cameras["webcam"] = replace(cameras["webcam"], extrinsics=poses["webcam"].tolist())
    mount = Mount("arm", "gripper", (torch.linalg.inv(link) @ poses["wrist"]).tolist())
    cameras["wrist"] = replace(cameras["wrist"], mount=mount, depth_scale=1e-4)
    batch = {"observation.state": state, extrinsics_key("moved"): poses["moved"].float().reshape(1, 16)}
    for name in ("front", "wrist", "moved"):
        depth = depth_of_plane(FLOOR, poses[name], cameras[name])
        batch[depth_key(name)] = (depth / (cameras[name].depth_scale or 1e-3)).round()
    batch["observation.depth_front"] = batch.pop(depth_key("front"))  # under a name of its own
    return batch, Rig(cameras, {"arm": arm})


KEYS = {"front": "observation.depth_front"}


def test_points_of_every_kind_of_camera_lie_on_the_floor():
    batch, rig = frame()
    scene = scene_of(batch, rig, depth_keys=KEYS)
    assert set(scene.points) == {"front", "wrist", "moved"}
    for name, points in scene.points.items():
        assert len(points) > 50, name
        assert np.abs(points[:, 2] - FLOOR).max() < 2e-3, name
    assert set(scene.cameras) == set(rig.cameras)
    for name, pose in (("wrist", above(0.1, -0.4)), ("webcam", above(0.2, 0.6)), ("moved", above(-0.3, 0.2))):
        np.testing.assert_allclose(scene.cameras[name], pose.numpy(), atol=1e-5)
    bones = scene.bones["arm"]
    places = ForwardKinematics(rig.arms["arm"], ["gripper", "wrist"])(batch["observation.state"].double())[0, :, :3, 3]
    assert any(np.allclose(bone, places.numpy()[::-1], atol=1e-5) for bone in bones)


def test_what_is_not_known_is_left_out():
    batch, rig = frame()
    del batch["observation.state"], batch[extrinsics_key("moved")]
    scene = scene_of(batch, rig, depth_keys=KEYS)
    assert set(scene.points) == {"front"}
    assert set(scene.cameras) == {"front", "webcam"}
    assert not scene.bones


def test_a_frame_of_several_rigs_is_seen_by_its_own():
    batch, rig = frame()
    other = Rig({"front": replace(rig.cameras["front"], extrinsics=above(0.0, 0.9).tolist())})
    both = Calibration(rigs={"2": rig, "5": other})
    for number, expected in ((2, rig), (5, other)):
        found = scene_of(batch | {RIG: torch.tensor([number])}, both, depth_keys=KEYS)
        single = scene_of(batch, expected, depth_keys=KEYS)
        assert all(np.array_equal(found.points[name], points) for name, points in single.points.items())
    for wrong, said in (({RIG: torch.tensor([[3]])}, "is 3"), ({}, "is not given")):
        with pytest.raises(ValueError, match=f"{said}, but the calibration has the rigs 2, 5"):
            scene_of(batch | wrong, both, depth_keys=KEYS)


def test_a_policy_shows_what_its_calibration_says():
    policy = make_policy()
    raw = make_observation(1)
    scene = scene_of_policy(policy.config, raw)
    assert set(scene.points) == set(policy.geometry.source.cameras)
    measured = policy.geometry.source(raw)
    for view, camera in enumerate(
        policy.geometry.source.cameras
    ):  # the mean of points is that of cells, by their shares
        weights = measured.features[0, view, :, 6]
        if camera == "front":
            expected = (measured.features[0, view, :, :3] * weights[:, None]).sum(dim=0) / weights.sum()
            np.testing.assert_allclose(scene.points[camera].mean(axis=0), expected.numpy(), atol=1e-4)


def test_a_policy_of_one_of_several_rigs_shows_that_ones():
    raw, rigs = make_observation(1), make_rigs(POSE)
    config = make_config(calibration={}, rigs=rigs, rig=5)
    alone = make_config(calibration=rigs["5"].cameras)
    found, expected = (scene_of_policy(c, raw) for c in (config, alone))
    assert found.points.keys() == expected.points.keys() != set()
    for camera, points in expected.points.items():
        np.testing.assert_array_equal(found.points[camera], points)


def test_pictures_and_files_are_written(tmp_path: Path):
    batch, rig = frame()
    for scene in (scene_of(batch, rig, depth_keys=KEYS), Scene({}, {}, {"webcam": above(0.0, 0.1).numpy()})):
        scene_figure(scene).savefig(tmp_path / "scene.png", dpi=30)
        assert (tmp_path / "scene.png").read_bytes().startswith(b"\x89PNG")
    pytest.importorskip("rerun")
    log_to_rerun(scene_of(batch, rig, depth_keys=KEYS), str(tmp_path / "scene.rrd"))
    content = (tmp_path / "scene.rrd").read_bytes()
    assert content.startswith(b"RRF2")
    assert len(content) > 12 * sum(len(points) for points in scene_of(batch, rig, depth_keys=KEYS).points.values()) / 4
