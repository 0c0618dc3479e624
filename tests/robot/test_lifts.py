"""Arms with prismatic joints: their motions are millimetres, and other offsets are open."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.geometry.calibration import read_calibration_file
from lerobot_policy_pi05_geometry.geometry.kinematics import Arm, ForwardKinematics, Link, StateJoint
from lerobot_policy_pi05_geometry.geometry.rigid import identity_rows
from lerobot_policy_pi05_geometry.robot.board import Detection
from lerobot_policy_pi05_geometry.robot.calibrate import make_arm
from lerobot_policy_pi05_geometry.robot.dataset_views import spread_out, still_frames
from lerobot_policy_pi05_geometry.robot.hand_eye import solve_hand_eye
from lerobot_policy_pi05_geometry.robot.hand_eye_problem import View
from lerobot_policy_pi05_geometry.robot.joint_offsets import levers, tellable
from lerobot_policy_pi05_geometry.robot.recording_checks import check_views
from pi05_geometry_cli import app
from tests.geometry.arms import STATE_NAMES, URDF, so101_like
from tests.robot.recordings import BOARD, INTRINSICS, make_recording

X, Y, Z = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]


def chain(*joints: tuple[str, str, list[float]]) -> ForwardKinematics:
    """Joints of a name, a kind and an axis, 10 cm above each other."""
    links = [Link("base")]
    up = identity_rows()
    up[2][3] = 0.1
    for name, kind, axis in joints:
        links.append(Link(f"link_{name}", links[-1].name, up, kind, name, axis))
    units = {"revolute": "degrees", "prismatic": "metres"}
    arm = Arm(links, [StateJoint(name, name, i, units[kind]) for i, (name, kind, _) in enumerate(joints)])
    arm.check("arm")
    return ForwardKinematics(arm, [links[-1].name])


TILT, ROLL, PAN = ("tilt", "revolute", Y), ("roll", "revolute", X), ("pan", "revolute", Z)
LIFT = ("lift", "prismatic", Z)


@pytest.mark.parametrize(
    ("joints", "told"),
    [
        ((PAN, TILT, ROLL), ["tilt"]),
        ((LIFT, PAN, TILT, ROLL), ["tilt"]),
        ((PAN, LIFT, TILT, ROLL), ["tilt"]),
        ((("rail", "prismatic", X), LIFT, PAN, TILT, ROLL), ["pan", "tilt"]),
        ((LIFT, TILT, ("elbow", "revolute", Y), ROLL), ["tilt", "elbow"]),
        ((PAN, TILT, LIFT, ("turn", "revolute", Z)), ["tilt"]),
        ((PAN,), []),
    ],
)
def test_offsets_that_a_recording_can_tell(joints, told):
    """An offset is open where it moves the base or what the hand carries; seen by the poses themselves."""
    kinematics = chain(*joints)
    assert [joint for joint, can in zip(kinematics.joints, tellable(kinematics), strict=True) if can] == told
    values = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (9, len(joints))))
    before = kinematics.poses(values)[:, 0].numpy()
    for number, joint in enumerate(kinematics.joints):
        moved = values.clone()
        moved[:, number] += 0.3
        after = kinematics.poses(moved)[:, 0].numpy()
        changes = after @ np.linalg.inv(before), np.linalg.inv(before) @ after  # of the base, and of the hand
        constant = [np.abs(change - change[0]).max() < 1e-9 for change in changes]
        assert any(constant) == (joint not in told)


def test_a_camera_that_sees_an_arm_on_a_lift_is_calibrated():
    """The offset of the joint that turns about the lift's direction turns the base: it is no more to be found than the lift's."""
    recording = make_recording(False, 0)
    base = so101_like()
    links = [Link("floor"), Link("base", "floor", identity_rows(), "prismatic", "lift", Z), *base.links[1:]]
    arm = Arm(links, [StateJoint("lift", "lift.pos", 5, "metres"), *base.joints])
    kinematics = ForwardKinematics(arm, ["gripper"])
    recording.offsets[[0, -1]] = 0.0
    views = []
    random = np.random.default_rng(1)
    fx, fy, cx, cy = INTRINSICS
    for view in recording.draw(24, pixel_noise=0.0, joint_noise=0.0):
        lift = random.uniform(-0.05, 0.05)
        values = np.append(lift, view.values)
        pose = kinematics.poses(torch.from_numpy(values + np.append(0.0, recording.offsets))[None])[0, 0].numpy()
        seen = np.linalg.inv(recording.camera) @ pose @ recording.board
        points = BOARD.corners @ seen[:3, :3].T + seen[:3, 3]
        pixels = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
        views.append(View(view.frame, values, Detection(np.arange(len(points)), pixels)))
    found = solve_hand_eye(kinematics, views, BOARD, INTRINSICS, [0.0] * 5, wrist=False)
    assert found.fixed_joints == ("lift", "shoulder_pan", "wrist_roll")
    np.testing.assert_allclose(list(found.offsets.values())[1:], recording.offsets, atol=np.radians(0.01))
    np.testing.assert_allclose(found.camera, recording.camera, atol=1e-4)
    assert "mm" in found.deviation

    wrong = [replace(view, values=view.values * [1.5, *[1.0] * 5]) for view in views]
    with pytest.raises(ValueError, match=r"'lift' moves 0\.67 times .* is no distance in the joint's unit"):
        solve_hand_eye(kinematics, wrong, BOARD, INTRINSICS, [0.0] * 5, wrist=False)


def test_a_lift_that_rises_is_no_arm_that_stands_still():
    kinematics = chain(PAN, LIFT, TILT)
    values = np.zeros((60, 3))
    values[:, 1] = 0.15 * np.arange(60) / 30  # 15 cm a second at 30 frames a second
    assert not len(still_frames(values / levers(kinematics), np.zeros(60)))
    values[:, 1] /= 100
    assert len(still_frames(values / levers(kinematics), np.zeros(60))) == 60
    values[:, 1] *= 100
    assert len(spread_out(values / levers(kinematics), np.arange(60), 60)) > 20


def test_a_lift_needs_millimetres_of_motion_and_not_degrees():
    kinematics = chain(TILT, LIFT, ROLL, PAN, ("bow", "revolute", Y))
    assert tellable(kinematics) == [False, True, True, True, False]
    random = np.random.default_rng(0)
    for travel, refused in ((0.02, False), (0.01, True)):
        values = random.uniform(-0.8, 0.8, (20, 5))
        values[:, 1] = np.linspace(0, travel, 20)
        seen = np.linalg.inv(kinematics.poses(torch.from_numpy(values))[:, 0].numpy())
        views = [View(i, row, Detection(np.arange(0), np.zeros((0, 2)))) for i, row in enumerate(values)]
        if refused:
            with pytest.raises(ValueError, match=r"Joint\(s\) lift moved by less than 14 mm"):
                check_views(kinematics, views, seen)
        else:
            check_views(kinematics, views, seen)


def test_the_unit_of_one_joint_is_said_beside_that_of_all(tmp_path):
    lifted = URDF.replace('<link name="base"/>', '<link name="base"/><link name="floor"/>').replace(
        "</robot>",
        '<joint name="lift" type="prismatic"><parent link="floor"/><child link="base"/><axis xyz="0 0 1"/></joint></robot>',
    )
    (tmp_path / "arm.urdf").write_text(lifted)
    names = [*STATE_NAMES, "lift.pos"]
    numbers = {"dtype": "float32", "shape": (7,), "names": names}
    features = {"observation.state": numbers, "action": numbers}
    dataset = LeRobotDataset.create("local/lift", fps=30, features=features, root=tmp_path / "data", use_videos=False)
    frame = {"observation.state": np.zeros(7, np.float32), "action": np.zeros(7, np.float32), "task": "x"}
    dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()
    given = [f"--model={tmp_path / 'arm.urdf'}", f"--dataset.root={tmp_path / 'data'}", f"--file={tmp_path / 'c.json'}"]

    def run(*more: str):
        return CliRunner().invoke(app, ["calibrate", "arm", *given, *more])

    for options, expected in (
        ((), ("degrees", "metres")),
        (("--unit=radians",), ("radians", "metres")),
        (("--unit=radians", "--unit=lift=millimetres"), ("radians", "millimetres")),
    ):
        assert run(*options).exit_code == 0
        units = {joint.joint: joint.unit for joint in read_calibration_file(tmp_path / "c.json").arms["arm"].joints}
        assert (units["elbow_flex"], units["lift"]) == expected
    for wrong, said in (
        ("--unit=lift=degrees", "unit must be metres or millimetres"),
        ("--unit=lfit=millimetres", "has no joint lfit; it has lift, shoulder_pan"),
    ):
        assert said in str(run(wrong).exception)
    assert "once for all joints" in str(run("--unit=radians", "--unit=degrees").exception)


def test_a_joint_and_an_entry_that_are_given_wrongly_are_refused():
    links = so101_like().links
    with pytest.raises(ValueError, match="has no joint elbow_flexx; it has shoulder_pan, "):
        make_arm(links, STATE_NAMES, {"elbow_flexx": "elbow_flex.pos"})
    with pytest.raises(ValueError, match="--unit names gripper, for which the state has no entry"):
        make_arm(links, STATE_NAMES[:5], units={"gripper": "radians"})
    with pytest.raises(ValueError, match=r"'wrist_flex\.pos' is given to two joints, elbow_flex and wrist_flex"):
        make_arm(links, STATE_NAMES, {"elbow_flex": "wrist_flex.pos"})
