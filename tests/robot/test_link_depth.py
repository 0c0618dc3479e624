"""Measured depth against the arm's links: rays equal a renderer, and a depth scale that is wrong is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

pytest.importorskip("mujoco")

from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.geometry.calibration import write_calibration_file
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration
from lerobot_policy_pi05_geometry.geometry.keys import depth_key
from lerobot_policy_pi05_geometry.robot import link_depth
from lerobot_policy_pi05_geometry.robot.link_depth import ArmShape, check_link_depth
from lerobot_policy_pi05_geometry.robot.link_files import read_links
from lerobot_policy_pi05_geometry.sim.headless import mujoco
from pi05_geometry_cli import app
from tests.geometry.arms import JOINTS, STATE_NAMES, URDF, mjcf_of, so101_like
from tests.robot.stubs import DEPTH_SCALE, HEIGHT, WIDTH, World, intrinsics, scene_xml, true_calibration

pytestmark = pytest.mark.sim

FRAMES, ROWS, COLUMNS = 8, 3 * HEIGHT, 3 * WIDTH
CAMERAS = ("front", "wrist")


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    monkeypatch.setattr(link_depth, "_ACROSS", 40)
    monkeypatch.setattr(link_depth, "MIN_PIXELS", 30)


def model_xml() -> str:
    """The scene with thicker links, and a finger, which the wrist camera sees."""
    finger = '<geom type="capsule" size="0.012" fromto="0.01 0.06 0.1 0 0.09 0.17"/>'
    head, name, tail = scene_xml().replace('size="0.015"', 'size="0.03"').partition('<body name="gripper"')
    start, bracket, rest = tail.partition(">")
    return head + name + start + bracket + finger + rest


def renderer_of(world: World) -> mujoco.Renderer:
    """Of images that are larger than those that the calibration holds for."""
    return mujoco.Renderer(world.model, ROWS, COLUMNS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("links")
    (made / "arm.xml").write_text(model_xml())
    return made


@pytest.fixture(scope="module")
def world(folder) -> World:
    made = World()
    made.model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    made.model.vis.quality.offsamples = 0
    return made


@pytest.fixture(scope="module")
def recorded(world, folder) -> LeRobotDataset:
    """Raw depth of both cameras as LeRobot records it: counts that it calls millimetres."""
    axes = ["height", "width", "channels"]
    info = {"is_depth_map": True, "depth_unit": "mm"}
    features = {
        depth_key(camera): {"dtype": "image", "shape": (ROWS, COLUMNS, 1), "names": axes, "info": info}
        for camera in CAMERAS
    }
    features["observation.state"] = {"dtype": "float32", "shape": (6,), "names": STATE_NAMES}
    dataset = LeRobotDataset.create("local/links", fps=10, features=features, root=folder / "data", use_videos=False)
    random, renderer = np.random.default_rng(0), renderer_of(world)
    for _ in range(FRAMES):
        motors = {joint: float(random.uniform(-25, 25)) for joint in JOINTS}
        frame = {"observation.state": np.array(list(motors.values()), np.float32), "task": "look"}
        for camera in CAMERAS:
            counts = np.rint(world.depth(renderer, camera, motors) / DEPTH_SCALE[camera])
            frame[depth_key(camera)] = np.where(counts < 65535, counts, 0).astype(np.uint16)[..., None]
        dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()
    renderer.close()
    return LeRobotDataset("local/links", root=folder / "data")


@pytest.mark.parametrize("camera", CAMERAS)
def test_rays_equal_a_renderer_where_the_arm_is_seen(camera, world, folder):
    calibration = true_calibration(world)
    shape = ArmShape(folder / "arm.xml", calibration.arms["arm"])
    fx, fy, cx, cy = calibration.cameras[camera].scaled_intrinsics(ROWS, COLUMNS)
    v, u = np.indices((ROWS, COLUMNS))
    rays = np.stack([(u - cx).ravel() / fx, (v - cy).ravel() / fy, np.ones(u.size)], axis=1)
    motors = dict(zip(JOINTS, (10.0, -20.0, 15.0, 5.0, -30.0, 0.0), strict=True))
    values = shape.kinematics.values(torch.tensor([list(motors.values())], dtype=torch.float64))[0].numpy()
    found = shape.depth(values, world.camera_pose(camera, motors), rays).reshape(ROWS, COLUMNS)
    renderer = renderer_of(world)
    rendered = world.depth(renderer, camera, motors)
    renderer.enable_segmentation_rendering()
    renderer.update_scene(world.data_of(motors), camera)
    geoms = renderer.render()[..., 0]
    renderer.close()
    bodies = [world.model.body(name).id for name in ("upper_arm", "lower_arm", "wrist", "gripper")]
    arm = (geoms >= 0) & np.isin(world.model.geom_bodyid[geoms.clip(0)], bodies)
    both = arm & np.isfinite(found)
    assert both.sum() >= 40
    assert (arm ^ np.isfinite(found)).sum() <= 0.1 * arm.sum()  # pixels at edges
    assert np.quantile(np.abs(found - rendered)[both], 0.9) < 2e-3  # at edges a renderer sees another part of a pixel


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_true_scale_passes_and_others_are_refused(camera, world, recorded, folder, monkeypatch):
    calibration = true_calibration(world)
    found = check_link_depth(recorded, calibration, camera, "arm", folder / "arm.xml")
    assert found.ratio == pytest.approx(1.0, abs=0.02)
    assert found.frames == FRAMES
    for factor, said in ((1.15, "1.1"), (0.85, "0.8"), (10.0, "10.0")):
        calibration.cameras[camera].depth_scale = factor * DEPTH_SCALE[camera]
        with pytest.raises(ValueError, match=rf"'{camera}' is {said}\d* times what the arm's links in its view say"):
            check_link_depth(recorded, calibration, camera, "arm", folder / "arm.xml")
    monkeypatch.setattr(link_depth, "MIN_PIXELS", 10**6)
    with pytest.raises(ValueError, match=r"measures the arm in \d+ of the pixels"):
        check_link_depth(recorded, calibration, camera, "arm", folder / "arm.xml")


def test_a_d405_without_its_scale_is_refused_by_the_command(world, recorded, folder):
    file = folder / "calibration.json"
    calibration = true_calibration(world)
    arguments = ["calibrate", "depth", "--camera=wrist", f"--model={folder / 'arm.xml'}", f"--file={file}"]
    arguments.append(f"--dataset.root={recorded.root}")
    write_calibration_file(file, calibration)
    told = CliRunner().invoke(app, arguments, catch_exceptions=False).output
    assert "times what its links say" in told
    calibration.cameras["wrist"].depth_scale = None
    write_calibration_file(file, calibration)
    with pytest.raises(ValueError, match=r"Depth of camera 'wrist' is (10\.0|9\.9)\d times .*a D405 counts in 0.1 mm"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_what_cannot_be_checked_is_said(world, recorded, folder):
    calibration = true_calibration(world)

    def refused(camera: str = "front", arm: str = "arm", model: str = "arm.xml") -> str:
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            check_link_depth(recorded, calibration, camera, arm, folder / model)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "no camera 'top' or no arm 'arm'; it has front, wrist, arm" in refused(camera="top")
    calibration.cameras["top"] = CameraCalibration(intrinsics(), [WIDTH, HEIGHT])
    assert "no depth of camera 'top'" in refused(camera="top")
    calibration.cameras["front"].extrinsics = None
    assert "'front' has no pose; find it with" in refused()
    (folder / "bare.xml").write_text(mjcf_of(so101_like()))
    assert "no shape on any link that the state moves" in refused("wrist", model="bare.xml")
    (folder / "bad.xml").write_text("<mujoco><worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>")
    assert "the file's meshes are needed, too" in refused("wrist", model="bad.xml")


def mounted_urdf(mount: str) -> str:
    """The arm with boxes of 10 cm on its links, on a stand. mount: `stand_T_base` as attributes of URDF's origin."""
    box = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.03 0.03 0.1"/></geometry></collision>'
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    urdf = URDF
    for name in ("shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw"):
        urdf = urdf.replace(
            f'<link name="{name}"/>', f'<link name="{name}">{mass}{box if name != "jaw" else ""}</link>'
        )
    stand = f'<joint name="stand_base" type="fixed"><parent link="stand"/><child link="base"/><origin {mount}/></joint>'
    return urdf.replace("</robot>", f'<link name="stand"/>{stand}</robot>')


def mounted_mjcf(mount: str) -> str:
    """The same as MuJoCo reads it, with bodies that it does not join: a stand, and the base on it."""
    spec = mujoco.MjSpec.from_string(mounted_urdf(mount).replace("<link", MJCF_OPTIONS + "<link", 1))
    spec.compile()
    return spec.to_xml()


MJCF_OPTIONS = '<mujoco><compiler fusestatic="false"/></mujoco>'
MOUNTS = ('xyz="0 0 0"', 'xyz="0.4 -0.3 0.7"', 'xyz="0.4 -0.3 0.7" rpy="0.5 -0.4 1.2"')


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("write", [mounted_urdf, mounted_mjcf])
def test_rays_do_not_depend_on_where_the_file_puts_the_base(write, mount, folder):
    """MuJoCo joins a URDF's fixed links, and its base, with what carries them: the base may be no body of its own."""
    file = folder / "mounted.xml"
    file.write_text(write(mount))
    arm = so101_like()
    arm.links = read_links(file, "base")
    shape = ArmShape(file, arm)
    state = torch.tensor([[10.0, -20.0, 15.0, 5.0, -30.0, 0.0]], dtype=torch.float64)
    values = shape.kinematics.values(state)
    poses = shape.kinematics.poses(values)[0].numpy()
    link = poses[shape.kinematics.links.index("gripper")]  # 10 cm above the top of its box, and looking down at it
    camera = link @ np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.2], [0, 0, 0, 1.0]])
    found = shape.depth(values[0].numpy(), camera, np.array([[0.0, 0.0, 1.0], [0.14, 0.1, 1.0], [9.0, 0.0, 1.0]]))
    np.testing.assert_allclose(found, [0.1, 0.1, np.nan], atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"upper_arm"', '"biceps"', "no link 'upper_arm' on joint 'shoulder_lift', as the arm has"),
        ('name="elbow_flex" type="revolute"', 'name="elbow_flex" type="fixed"', "no link 'lower_arm' on joint"),
        ("0 0 0.135", "0 0 0.136", r"Link '\w+' of .* stands elsewhere than the arm's"),
        ('<axis xyz="0 0 2"/>', '<axis xyz="0 1 0"/>', r"Link '\w+' of .* stands elsewhere than the arm's"),
    ],
)
def test_the_file_of_another_arm_is_refused(old, new, said, folder):
    (folder / "other.urdf").write_text(mounted_urdf(MOUNTS[2]).replace(old, new))
    with pytest.raises(ValueError, match=f"{said}.*give the link file that `pi05-geometry calibrate arm` read") as told:
        ArmShape(folder / "other.urdf", so101_like())
    assert "\n" not in str(told.value)
