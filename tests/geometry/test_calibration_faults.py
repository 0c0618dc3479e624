"""Calibrations and poses that do not belong to the images, or to the robot: refused, or taken as they are meant."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.geometry.calibration import (
    Calibration,
    Rig,
    parse_calibration,
    write_calibration_file,
)
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration, Mount
from lerobot_policy_pi05_geometry.geometry.dataset_calibration import check_state_names, write_dataset_calibration
from lerobot_policy_pi05_geometry.geometry.keys import RIG
from lerobot_policy_pi05_geometry.geometry.placed_camera import PlacedCamera
from lerobot_policy_pi05_geometry.geometry.resolve import resolve
from lerobot_policy_pi05_geometry.geometry.rigid import FARTHEST, identity_rows
from lerobot_policy_pi05_geometry.inspect import inspection
from lerobot_policy_pi05_geometry.robot.link_depth import check_link_depth
from pi05_geometry_cli import app

from ..entry_points import (
    FRONT,
    FRONT_DEPTH,
    WRIST_DEPTH,
    WRIST_POSE,
    make_batch,
    make_calibration,
    make_config,
    make_features,
    make_observation,
    make_policy,
    without,
)
from ..serving.running import make_rigs
from .arms import STATE_NAMES, so101_like


def placed(size: tuple[int, int], rotation: int = 0) -> PlacedCamera:
    camera = CameraCalibration([600.0, 600.0, 319.5, 239.5], [640, 480], identity_rows(), rotation=rotation)
    return PlacedCamera("front", {0: Rig({"front": camera})}, size)


@pytest.mark.parametrize("size", [(480, 640), (240, 320), (84, 112), (63, 84), (53, 70), (10, 13)])
def test_a_view_that_is_only_resized_is_taken(size):
    placed(size).check_view()
    placed(size[::-1], rotation=90).check_view()


@pytest.mark.parametrize("size", [(640, 480), (480, 848), (224, 224), (360, 640)])
def test_images_of_another_shape_than_the_calibration_are_refused(size):
    """They were turned, cropped or squeezed: no scale makes these intrinsics theirs."""
    with pytest.raises(ValueError, match=r"Images of camera 'front' are .* its calibration is of 640 x 480"):
        placed(size).check_view()
    if size != (640, 480):
        with pytest.raises(ValueError, match="another shape"):
            placed(size[::-1], rotation=90).check_view()


def test_depth_of_another_shape_is_refused_by_the_policy_and_rgb_behind_rays_is_not():
    """A π0.5 declares 224 x 224 for RGB, whatever arrives, and rays through cells depend on no size."""
    inputs, _ = make_features()
    inputs[FRONT_DEPTH] = PolicyFeature(FeatureType.VISUAL, (1, 24, 18))
    with pytest.raises(ValueError, match="another shape"):
        make_policy(input_features=inputs)
    square = make_features()[0] | {FRONT: PolicyFeature(FeatureType.VISUAL, (3, 20, 20))}
    rays = make_policy(geometry_source="rays", input_features=square).eval().geometry.source(make_observation(1))
    expected = make_policy(geometry_source="rays").eval().geometry.source(make_observation(1))
    torch.testing.assert_close(rays.features, expected.features, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "intrinsics",
    [[0.9, 1.2, 0.5, 0.5], [600, 600, 5000, 240], [600, 600, 320, -3000], [60_000, 600, 320, 240], [600, 20, 320, 240]],
)
def test_intrinsics_that_are_no_pixels_of_the_image_are_refused(intrinsics):
    content = {"frame": "base", "cameras": {"front": {"intrinsics": intrinsics, "size": [640, 480]}}}
    with pytest.raises(ValueError, match="no pixels of an image of 640 x 480"):
        parse_calibration(content, "file")


def test_a_translation_in_millimetres_is_refused():
    pose = identity_rows()
    pose[2][3] = 900.0
    content = {"intrinsics": [600, 600, 320, 240], "size": [640, 480], "extrinsics": pose}
    with pytest.raises(ValueError, match="give metres, not millimetres"):
        parse_calibration({"frame": "base", "cameras": {"front": content}}, "file")
    pose[2][3] = FARTHEST - 1
    parse_calibration({"frame": "base", "cameras": {"front": content}}, "file")
    policy, observation = make_policy().eval(), make_observation(2)
    observation[WRIST_POSE][1, 0, 3] = 400.0
    with pytest.raises(ValueError, match=r"wrist\.extrinsics has a translation of more than 100 m"):
        policy.geometry.source(observation)


@pytest.mark.parametrize("name", ["left", "01", "-1", "1.0", ""])
def test_rigs_have_numbers(name):
    """01 and 1 would be the same rig."""
    with pytest.raises(ValueError, match="give a whole number as its name"):
        parse_calibration({"version": 2, "frame": "base", "rigs": {name: {"cameras": {}}}}, "file")
    for known in ("0", "10"):
        parse_calibration({"version": 2, "frame": "base", "rigs": {known: {"cameras": {}}}}, "file")


# --- which entries of the state an arm's joints are -----------------------------------------------------------------

GRIPPER_FIRST = ["gripper.pos", *STATE_NAMES[:5]]


def on_arm() -> dict[str, CameraCalibration]:
    cameras = make_calibration()
    return cameras | {"wrist": replace(cameras["wrist"], mount=Mount("arm", "gripper", identity_rows()))}


def features_with(names) -> dict:
    info = {"is_depth_map": True, "depth_unit": "m"}
    images = {key: {"dtype": "image", "shape": [12, 16, 1], "info": info} for key in (FRONT_DEPTH, WRIST_DEPTH)}
    return {**images, "observation.state": {"dtype": "float32", "shape": [6], "names": names}}


def test_an_arm_whose_joints_are_other_entries_of_the_state_is_refused(tmp_path):
    """A wrist camera would stand where another arm's hand is, without a word."""
    calibration, folder = Calibration(on_arm(), {"arm": so101_like()}), tmp_path / "data" / "meta"
    folder.mkdir(parents=True)
    write_calibration_file(tmp_path / "calibration.json", calibration)
    command = ["store-calibration", str(tmp_path / "calibration.json"), f"--dataset.root={tmp_path / 'data'}"]
    for names, refused in ((GRIPPER_FIRST, True), (STATE_NAMES, False)):
        (folder / "info.json").write_text(json.dumps({"features": features_with(names)}))
        result = CliRunner().invoke(app, command)
        assert (result.exit_code != 0) == refused, result.output
    said = r"joint 'shoulder_pan' of arm 'arm' is state entry 0, 'shoulder_pan.pos', but the dataset's state has gripper.pos, "
    inputs = make_features()[0] | {"observation.state": PolicyFeature(FeatureType.STATE, (6,))}
    config = make_config(calibration=calibration.cameras, arms=calibration.arms, input_features=inputs)
    config.validate_features()
    meta = SimpleNamespace(features=features_with(GRIPPER_FIRST), root=tmp_path, robot_type=None)
    with pytest.raises(ValueError, match=said):
        resolve(config, meta)
    meta.features = features_with(STATE_NAMES)
    resolve(config, meta)


def test_no_picture_and_no_check_of_depth_is_made_with_other_entries_of_the_state(tmp_path, monkeypatch):
    calibration, folder = Calibration(on_arm(), {"arm": so101_like()}), tmp_path / "meta"
    folder.mkdir()
    (folder / "info.json").write_text("{}")
    write_calibration_file(tmp_path / "calibration.json", calibration)

    class Recorded:
        """A dataset of which only the features are read."""

        meta = SimpleNamespace(features=features_with(GRIPPER_FIRST), root=tmp_path)

        def __init__(self, *_, **__) -> None:
            pass

        def __len__(self) -> int:
            return 1

    config = SimpleNamespace(depth_unit="mm", calibration=calibration.cameras, arms=calibration.arms, rigs={})
    monkeypatch.setattr("lerobot.datasets.lerobot_dataset.LeRobotDataset", Recorded)
    monkeypatch.setattr(inspection, "LeRobotDataset", Recorded)
    monkeypatch.setattr(inspection, "load_policy", lambda *_: SimpleNamespace(policy=SimpleNamespace(config=config)))
    scene = ["scene", f"--dataset.root={tmp_path}", f"--file={tmp_path / 'calibration.json'}"]
    for call in (
        lambda: CliRunner().invoke(app, scene, catch_exceptions=False),
        lambda: inspection.write_inspection("checkpoint", tmp_path, "local/data", 0, "cpu", tmp_path / "page.html"),
        lambda: check_link_depth(Recorded(), calibration, "wrist", "arm", tmp_path / "arm.urdf"),
    ):
        with pytest.raises(ValueError, match="is state entry 0"):
            call()


def test_state_entries_are_compared_on_every_rig_and_only_where_they_are_named(tmp_path):
    two = Calibration(rigs={"0": Rig(make_calibration()), "1": Rig(on_arm(), {"arm": so101_like()})})
    with pytest.raises(ValueError, match="is state entry 0"):
        check_state_names(two, features_with(GRIPPER_FIRST))
    with pytest.raises(ValueError, match="is state entry 0"):
        check_state_names(two, features_with({"motors": GRIPPER_FIRST}))
    check_state_names(two, features_with({"motors": STATE_NAMES}))
    for unnamed in (None, ["state"]):
        check_state_names(two, features_with(unnamed))
    unused = Calibration(make_calibration(), {"arm": so101_like()})  # no camera is on it
    check_state_names(unused, features_with(GRIPPER_FIRST))
    with pytest.raises(FileNotFoundError):
        write_dataset_calibration(tmp_path, unused)


# --- which rig ----------------------------------------------------------------------------------------------------


def rig_policy(**settings):
    inputs, _ = make_features()
    inputs[RIG] = PolicyFeature(FeatureType.STATE, (1,))
    return make_policy(calibration={}, rigs=make_rigs(identity_rows()), input_features=inputs, **settings)


def test_a_rig_that_the_data_contradicts_is_refused_and_never_used():
    """With --policy.rig=2 every frame would have rig 2's geometry, without a word."""
    batch = make_batch(2) | {RIG: torch.tensor([[2], [5]])}
    several, one = rig_policy().train(), rig_policy(rig=2).train()
    with pytest.raises(ValueError, match=r"rig has 2, 5, but --policy\.rig is 2; train .* with --policy\.rig=null"):
        one.forward(batch)
    found, expected = (policy.geometry.source(batch, check=False) for policy in (one, several))
    assert torch.equal(found.features, expected.features)
    alone = make_batch(2) | {RIG: torch.tensor([[2], [2]])}
    assert torch.equal(one.geometry.source(alone).features, several.geometry.source(alone).features)
    told = without(alone, RIG)
    assert torch.equal(one.geometry.source(told).features, several.geometry.source(alone).features)


# --- turned images ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["rgbd", "rays"])
@pytest.mark.parametrize("rotation", [90, 180, 270])
def test_a_pose_that_comes_with_the_frame_holds_for_the_sensor_as_the_calibrations_does(source, rotation):
    """The same pose, once in the calibration and once in the frame, gives the same geometry."""
    observation = make_observation(2)
    observation[WRIST_POSE] = observation[WRIST_POSE][:1].expand(2, 4, 4).clone()
    in_frame, in_file = make_calibration(), make_calibration()
    for calibration in (in_frame, in_file):
        calibration["wrist"].rotation = rotation
        calibration["wrist"].size = calibration["wrist"].size[::-1] if rotation % 180 else calibration["wrist"].size
    in_file["wrist"].extrinsics = observation[WRIST_POSE][0].tolist()
    inputs = {key: feature for key, feature in make_features()[0].items() if key != WRIST_POSE}
    framed = make_policy(geometry_source=source, calibration=in_frame).eval()
    filed = make_policy(geometry_source=source, calibration=in_file, input_features=inputs).eval()
    found = framed.geometry.source(observation)
    expected = filed.geometry.source(without(observation, WRIST_POSE))
    torch.testing.assert_close(found.features, expected.features, atol=1e-5, rtol=1e-5)
    straight = make_policy(geometry_source=source).eval().geometry.source(observation)
    assert (straight.features[:, 1] - found.features[:, 1]).abs().max() > 1e-2
