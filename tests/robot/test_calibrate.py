"""From link files, a camera and a recording to a calibration file, by the commands."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.geometry.calibration import Calibration, read_calibration_file, write_calibration_file
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration, ColorStream, Mount, pose_of_sensor
from lerobot_policy_pi05_geometry.geometry.kinematics import Arm, ForwardKinematics, Link
from lerobot_policy_pi05_geometry.robot import realsense
from lerobot_policy_pi05_geometry.robot.board import Board
from lerobot_policy_pi05_geometry.robot.calibrate import check_board_depth, image_stream, keep_offsets, make_arm
from lerobot_policy_pi05_geometry.robot.dataset_views import image_size, spread_out, still_frames
from lerobot_policy_pi05_geometry.robot.link_files import read_links
from pi05_geometry_cli import app
from tests.geometry.arms import STATE_NAMES, URDF, mjcf_of, random_arm, random_state, so101_like
from tests.geometry.scenes import generator, random_pose
from tests.robot.recordings import BOARD, INTRINSICS, SIZE, Recording, aligned_errors, make_recording

# --- link files -----------------------------------------------------------------------------------------------------------


@pytest.mark.sim
@pytest.mark.parametrize("seed", range(5))
def test_an_mjcf_gives_the_arm_that_it_was_written_from(seed, tmp_path):
    pytest.importorskip("mujoco")
    arm = random_arm(generator(seed), 6)
    (tmp_path / "arm.xml").write_text(mjcf_of(arm))
    read = Arm(read_links(tmp_path / "arm.xml", "root"), arm.joints, arm.base_T_root)
    read.check("arm")
    names = [link.name for link in arm.links]
    state = random_state(generator(seed), arm, 3, width=8).double()
    found, expected = ForwardKinematics(read, names)(state), ForwardKinematics(arm, names)(state)
    assert (found - expected).abs().max() <= 1e-9


def test_a_urdf_is_read_and_a_base_chosen(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    assert read_links(tmp_path / "arm.urdf") == so101_like().links
    names = [link.name for link in read_links(tmp_path / "arm.urdf", "lower_arm")]
    assert names == ["lower_arm", "wrist", "gripper", "jaw", "tip"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("</robot>", "", "no XML"),
        ("robot", "sdf", "neither a URDF"),
        ('type="continuous"', 'type="floating"', "type 'floating'"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "axis of length 0"),
        ('xyz="0 0 0.06"', 'xyz="0 0"', "3 finite numbers"),
        ('<parent link="base"/>', '<parent link="tip"/>', "in a circle"),
        ('<link name="tip"/>', '<link name="tip"/><link name="floor"/>', "2 root links"),
        ("<robot", "<!DOCTYPE r [<!ENTITY a 'b'>]><robot", "XML entities"),
    ],
)
def test_unusable_link_files_are_refused(old, new, said, tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF.replace(old, new))
    with pytest.raises(ValueError, match=said):
        read_links(tmp_path / "arm.urdf")


def urdf_of(*joints: tuple[str, str, str, str, str]) -> str:
    """joints: name, type, what it mimics as XML, parent and child link."""
    links = "".join(f'<link name="{name}"/>' for name in ("base", *(child for *_, child in joints)))
    return f"<robot>{links}" + "".join(
        f'<joint name="{name}" type="{kind}">{mimic}<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/></joint>'
        for name, kind, mimic, parent, child in joints
    ) + "</robot>"  # fmt: skip


JAW = ("jaw", "prismatic", '<mimic joint="motor" multiplier="0.01"/>', "base", "jaw")
MOTOR = ("motor", "revolute", "", "base", "pinion")
OTHER_JAW = ("other", "prismatic", '<mimic joint="jaw" multiplier="-2" offset="0.001"/>', "base", "other_jaw")


@pytest.mark.parametrize("order", [(MOTOR, JAW, OTHER_JAW), (JAW, MOTOR, OTHER_JAW), (JAW, OTHER_JAW, MOTOR)])
def test_jaws_slide_with_a_motor_that_turns_whatever_the_order_of_links(order, tmp_path):
    """The second jaw mimics the first, which mimics the motor: 90 degrees are 1.57 radians."""
    (tmp_path / "arm.urdf").write_text(urdf_of(*order))
    arm = make_arm(read_links(tmp_path / "arm.urdf"), ["motor.pos"])
    assert [(joint.joint, joint.unit) for joint in arm.joints] == [("motor", "degrees")]
    found = ForwardKinematics(arm, ["jaw", "other_jaw"])(torch.tensor([[90.0]]).double())[0, :, 2, 3]
    moved = 0.01 * np.pi / 2
    np.testing.assert_allclose(found, [moved, -2 * moved + 0.001], atol=1e-9)


@pytest.mark.parametrize(
    ("mimic", "said"),
    [
        ("other", "'jaw' in .* mimics itself"),
        ("held", "'held', which is of type 'fixed'"),
        ("x", "'x', which is not there"),
    ],
)
def test_a_joint_that_mimics_what_never_moves_is_refused(mimic, said, tmp_path):
    jaw = ("jaw", "prismatic", f'<mimic joint="{mimic}"/>', "base", "jaw")
    (tmp_path / "arm.urdf").write_text(urdf_of(jaw, OTHER_JAW, ("held", "fixed", "", "base", "hand")))
    with pytest.raises(ValueError, match=said):
        read_links(tmp_path / "arm.urdf")


def test_an_arm_whose_links_contradict_each_other_about_a_joint_is_refused():
    """As files have it that were written before a link knew the kind of the joint that it mimics."""
    links = [
        Link("base"),
        Link("a", "base", kind="prismatic", joint="j"),
        Link("b", "base", kind="revolute", joint="j"),
    ]
    with pytest.raises(
        ValueError, match=r"Arm 'arm': joint 'j' is prismatic for one link and revolute for link 'b'.*calibrate arm"
    ):
        Arm(links, []).check("arm")


def test_joints_are_found_by_their_names():
    arm = make_arm(so101_like().links, STATE_NAMES)
    assert [(joint.joint, joint.index) for joint in arm.joints][:2] == [("shoulder_pan", 0), ("shoulder_lift", 1)]
    named = make_arm(so101_like().links, ["a", "b"], {"elbow_flex": "b"})
    assert [(joint.joint, joint.state, joint.index) for joint in named.joints] == [("elbow_flex", "b", 1)]
    with pytest.raises(ValueError, match=r"No joint of the link file.*--joint NAME=ENTRY"):
        make_arm(so101_like().links, ["x", "y"])
    with pytest.raises(ValueError, match=r"no entry c; it has a, b"):
        make_arm(so101_like().links, ["a", "b"], {"elbow_flex": "c"})


def test_offsets_stay_with_joints_that_stay_the_same():
    """`calibrate arm` may be run again after hand-eye calibration has found the offsets."""
    before = make_arm(so101_like().links, STATE_NAMES)
    before.joints = [replace(joint, offset=0.1 * (i + 1)) for i, joint in enumerate(before.joints)]
    again = make_arm(so101_like().links, STATE_NAMES)
    assert keep_offsets(again, before) == [joint.joint for joint in before.joints]
    assert again.joints == before.joints
    turned = make_arm(so101_like().links, STATE_NAMES)
    turned.joints[0] = replace(turned.joints[0], sign=-1)
    assert keep_offsets(turned, before) == [joint.joint for joint in before.joints[1:]]
    longer = make_arm(so101_like().links, STATE_NAMES)
    longer.links[1] = replace(longer.links[1], origin=random_pose(generator(0)).tolist())
    assert keep_offsets(longer, before) == []
    assert keep_offsets(make_arm(so101_like().links, STATE_NAMES), None) == []


# --- cameras --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def pyrealsense2(monkeypatch) -> SimpleNamespace:
    """Names of pyrealsense2 that reading profiles needs."""
    lens = SimpleNamespace(none=0, brown_conrady=1, inverse_brown_conrady=2, ftheta=3)
    made = SimpleNamespace(distortion=lens)
    monkeypatch.setattr(realsense, "_pyrealsense2", lambda: made)
    return made


def profile(fx: float, coeffs: list[float], model: int, to_depth: np.ndarray | None = None) -> SimpleNamespace:
    """A stream profile as pyrealsense2 has it."""
    intrinsics = SimpleNamespace(
        width=640, height=480, fx=fx, fy=fx + 1, ppx=320.0, ppy=241.0, coeffs=coeffs, model=model
    )
    made = SimpleNamespace(get_intrinsics=lambda: intrinsics)
    made.as_video_stream_profile = lambda: made
    if to_depth is not None:
        columns = to_depth[:3, :3].T.ravel().tolist()
        made.get_extrinsics_to = lambda _: SimpleNamespace(rotation=columns, translation=to_depth[:3, 3].tolist())
    return made


def test_a_realsense_says_what_it_knows(pyrealsense2):
    apart = random_pose(generator(0), 0.05).numpy()
    depth, color = profile(600.0, [0.0] * 5, 1), profile(610.0, [0.1, 0.2, 0.0, 0.0, 0.0], 1, apart)
    found = realsense.calibration_of(depth, color, 9.999999747378752e-05, 90)
    assert found.intrinsics == [600.0, 601.0, 320.0, 241.0]
    assert found.depth_scale == 1e-4
    assert found.rotation == 90
    np.testing.assert_allclose(found.color.depth_T_color, apart, atol=1e-9)
    assert found.color.distortion == [0.1, 0.2, 0.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="depth stream is distorted"):
        realsense.calibration_of(profile(600.0, [0.1] * 5, 1), color, 1e-3)
    with pytest.raises(ValueError, match="lens model 3"):
        realsense.calibration_of(depth, profile(610.0, [0.0] * 5, 3, apart), 1e-3)


def test_the_colour_streams_place_is_taken_into_account():
    apart = random_pose(generator(1), 0.05).numpy()
    colour = ColorStream([500.0, 500.0, 320.0, 240.0], [640, 480], apart.tolist(), [0.0] * 5)
    for rotation in (0, 90, 180, 270):
        camera = CameraCalibration([600.0, 600.0, 320.0, 240.0], [640, 480], rotation=rotation, color=colour)
        stream = image_stream(camera, "front", None)
        pose = random_pose(generator(2)).numpy()  # of the depth sensor
        recorded = CameraCalibration(
            [1.0] * 4, [640, 480], pose.tolist(), rotation=rotation, color=colour
        ).as_recorded()
        colour_pose = np.array(recorded.extrinsics) @ np.array(recorded.color.depth_T_color)
        np.testing.assert_allclose(pose_of_sensor(colour_pose @ stream.stream_T_depth, rotation), pose, atol=1e-9)
    with pytest.raises(ValueError, match="does not say where its colour stream stands"):
        image_stream(CameraCalibration([600.0] * 4, [640, 480]), "front", None)
    with pytest.raises(ValueError, match="are 320 x 240 pixels"):
        image_stream(CameraCalibration([600.0] * 4, [640, 480], stream="color"), "front", [240, 320, 3])


# --- recordings -----------------------------------------------------------------------------------------------------------


def test_moving_frames_are_left_out():
    values = np.zeros((12, 2))
    values[6:, 0] = 0.1
    assert still_frames(values, np.zeros(12)).tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert still_frames(values, np.arange(12) // 6).tolist() == list(range(12))  # another episode is no motion


def test_the_size_of_images_is_read_in_either_order():
    assert image_size({"shape": (480, 640, 3), "names": ["height", "width", "channels"]}) == (480, 640)
    assert image_size({"shape": [3, 480, 640], "names": ["channels", "height", "width"]}) == (480, 640)
    assert image_size({"shape": [480, 640, 3], "names": None}) == (480, 640)


def test_frames_are_spread_out():
    values = np.radians([[0.0], [1.0], [10.0], [10.5], [40.0], [41.0]])
    assert spread_out(values, np.arange(6), 3) == [0, 5, 3]
    assert len(spread_out(values, np.arange(6), 6)) == 3  # closer than 2 degrees says nothing new


def rendered(recording: Recording, values: np.ndarray) -> np.ndarray:
    """The board as the camera sees it, (H, W, 3) uint8."""
    pose = recording.camera_T_board(values[None])[0]
    fx, fy, cx, cy = INTRINSICS
    scale = 60  # pixels a square
    to_board = np.array(
        [
            [BOARD.square / scale, 0, 0.5 * BOARD.square / scale],
            [0, BOARD.square / scale, 0.5 * BOARD.square / scale],
            [0, 0, 1],
        ]
    )
    homography = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) @ pose[:3, [0, 1, 3]] @ to_board
    picture = cv2.copyMakeBorder(BOARD.picture(scale), 0, 0, 0, 0, cv2.BORDER_CONSTANT)
    image = cv2.warpPerspective(picture, homography, SIZE, flags=cv2.INTER_AREA, borderValue=128)
    noise = recording.random.normal(0, 3, image.shape)
    return np.repeat((image + noise).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def test_the_board_is_found_to_a_third_of_a_pixel():
    recording = make_recording(False, 20)
    for view in recording.draw(3, joint_noise=0.0, pixel_noise=0.0):
        true = view.values + recording.offsets
        seen = BOARD.detect(rendered(recording, true))
        pixels, _ = recording.project(true[None])
        assert np.abs(seen.pixels - pixels[0][seen.ids]).mean() < 0.3
    assert BOARD.detect(np.zeros((100, 100, 3), np.uint8)) is None


@pytest.mark.parametrize(
    "text",
    ["7x5", "7x5:30:40", "2x5:30:22", "7x5:30:22:9X9_1", "7x5:0:0", "axb:30:22", "7x5:3000:22", "40x40:30:22:4X4_50"],
)
def test_boards_that_cannot_be_are_refused(text):
    with pytest.raises(ValueError, match="A board is written COLUMNSxROWS"):
        Board.parse(text)


def record_board(recording: Recording, root, poses: int, held: int = 5) -> None:
    """A dataset as lerobot-record makes it, in which the arm holds each pose for some frames."""
    axes = ["height", "width", "channels"]
    features = {
        "observation.images.front": {"dtype": "image", "shape": (SIZE[1], SIZE[0], 3), "names": axes},
        "observation.state": {"dtype": "float32", "shape": (6,), "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": (6,), "names": STATE_NAMES},
    }
    dataset = LeRobotDataset.create("local/board", fps=30, features=features, root=root, use_videos=False)
    for view in recording.draw(poses, pixel_noise=0.0):
        true = view.values + recording.offsets
        image = rendered(recording, true)
        state = np.append(np.degrees(view.values), 10.0).astype(np.float32)
        for _ in range(held):
            frame = {"observation.images.front": image, "observation.state": state, "action": state, "task": "board"}
            dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()


def test_the_commands_calibrate_a_fixed_camera(tmp_path):
    recording = make_recording(False, 21)
    record_board(recording, tmp_path / "data", 18)
    (tmp_path / "arm.urdf").write_text(URDF)
    file, root = tmp_path / "calibration.json", f"--dataset.root={tmp_path / 'data'}"
    camera = CameraCalibration(INTRINSICS, list(SIZE), stream="color", depth_scale=1e-3)
    write_calibration_file(file, Calibration({"front": camera}))

    def run(*arguments: str) -> str:
        result = CliRunner().invoke(app, ["calibrate", *arguments, f"--file={file}"], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    assert "elbow_flex.pos" in run("arm", f"--model={tmp_path / 'arm.urdf'}", root)
    carried = replace(camera, mount=Mount("arm", "gripper", np.eye(4).tolist()))
    arms = read_calibration_file(file).arms
    # The recording is of one arm of two: the other one's joints are no entries of its state.
    far = [replace(joint, state=f"other_{joint.state}", index=joint.index + 6) for joint in arms["arm"].joints]
    arms["other"] = replace(arms["arm"], joints=far)
    elsewhere = replace(camera, mount=Mount("other", "gripper", np.eye(4).tolist()))
    write_calibration_file(file, Calibration({"front": camera, "wrist": carried, "elsewhere": elsewhere}, arms))
    options = ("--camera=front", "--link=gripper", "--fixed", "--board=7x5:30:22", root)
    told = run("hand-eye", *options, f"--picture={tmp_path / 'scene.png'}")
    assert "held out" in told
    assert "as it was, by convention" in told
    assert "wrist: placed with the offsets that the arm had before" in told
    assert (tmp_path / "scene.png").stat().st_size > 1000
    found = read_calibration_file(file)
    millimetres, degrees = aligned_errors(recording, np.array(found.cameras["front"].extrinsics))
    assert millimetres < 3
    assert degrees < 0.5
    offsets = np.array([joint.offset for joint in found.arms["arm"].joints[:5]])
    assert np.abs(offsets - recording.offsets)[1:4].max() < np.radians(1.0)
    assert json.loads(file.read_text())["version"] == 2

    told = run("hand-eye", *options, "--keep-offsets", f"--picture={tmp_path / 'scene.png'}")
    assert "kept their offsets" in told
    assert "placed with the offsets" not in told
    again = read_calibration_file(file)
    assert again.arms == found.arms
    assert (
        np.abs(np.array(again.cameras["front"].extrinsics) - np.array(found.cameras["front"].extrinsics)).max() < 2e-3
    )


def test_depth_of_a_board_that_is_ten_times_too_far_is_an_error():
    recording = make_recording(False, 22)
    views = recording.draw(12)
    camera = CameraCalibration(INTRINSICS, list(SIZE), stream="color", depth_scale=1e-3)
    stream = image_stream(camera, "front", None)

    class Frames:
        """A dataset whose depth is the board's plane, in counts of `scale` metres."""

        meta = SimpleNamespace(features={"observation.images.front_depth": {}})

        def __init__(self, scale: float) -> None:
            self.scale = scale

        def __getitem__(self, frame: int) -> dict:
            view = next(view for view in views if view.frame == frame)
            pose = recording.camera_T_board((view.values + recording.offsets)[None])[0]
            v, u = np.indices((SIZE[1], SIZE[0]))
            fx, fy, cx, cy = INTRINSICS
            rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
            depth = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2]) / self.scale
            return {"observation.images.front_depth": torch.from_numpy(depth)[None].float()}

    check_board_depth(Frames(1e-3), "front", camera, stream, views, BOARD)
    with pytest.raises(ValueError, match=r"Depth of camera 'front' is (9\.\d|10\.\d)\d? times"):
        check_board_depth(Frames(1e-4), "front", camera, stream, views, BOARD)
    with pytest.raises(ValueError, match=r"is 0.\d+ times"):
        check_board_depth(Frames(1.2e-3), "front", camera, stream, views, BOARD)
