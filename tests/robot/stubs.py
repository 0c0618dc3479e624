"""Hardware for LeRobot's own SO-101 and RealSense classes: a motor bus and a `pyrealsense2` with a MuJoCo arm behind them.

Only what stands below LeRobot is replaced: its robot, its cameras with their reading threads, its recording and its rollout are
the real ones. A reading of the motors waits until every camera has handed over an image of the present pose, so that image and
state belong together, however slow the machine is.
"""

import math
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import torch

from lerobot_policy_pi05_geometry.geometry.calibration import Calibration
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration, Mount
from lerobot_policy_pi05_geometry.geometry.kinematics import ForwardKinematics
from lerobot_policy_pi05_geometry.sim.headless import mujoco
from tests.geometry.arms import JOINTS, mjcf_of, so101_like

WIDTH, HEIGHT = 40, 32
SERIALS = {"111": "front", "222": "wrist"}
DEPTH_SCALE = {"front": 1e-3, "wrist": 1e-4}  # a D435 and a D405
# What the motors' zeros are off, degrees: LeRobot's are the middle of the recorded range.
OFFSETS = {
    "shoulder_pan": 0.0,
    "shoulder_lift": 3.0,
    "elbow_flex": -4.0,
    "wrist_flex": 2.0,
    "wrist_roll": 0.0,
    "gripper": 0.0,
}
_FOVY = 58.0


def scene_xml() -> str:
    """The arm over a table with boxes, a camera in front and one on the gripper."""
    front = f'<camera name="front" pos="0.05 -0.9 0.55" xyaxes="1 0 0 0 0.6 0.8" fovy="{_FOVY}"/>'
    table = '<geom type="plane" size="2 2 0.1" rgba="0.5 0.5 0.5 1"/>'
    boxes = "".join(
        f'<geom type="box" size="0.03 0.03 {height}" pos="{x} {y} {height}" rgba="{x + 0.5} 0.3 0.6 1"/>'
        for x, y, height in ((-0.1, -0.3, 0.02), (0.12, -0.35, 0.05), (0.0, -0.45, 0.03), (0.2, -0.2, 0.04))
    )
    wrist = f'<camera name="wrist" pos="0 0.06 0.03" xyaxes="1 0 0 0 -0.94 0.34" fovy="{_FOVY}"/>'
    xml = mjcf_of(so101_like())
    xml = xml.replace("<worldbody>", f"<worldbody>{front}{table}{boxes}<light pos='0 0 3'/>")
    for body in ("upper_arm", "lower_arm", "wrist"):
        geom = '<geom type="capsule" size="0.015" fromto="0 0 0 0 0 0.05"/>'
        xml = xml.replace(f'<body name="{body}"', f'<body name="{body}"', 1)
        start = xml.index(f'<body name="{body}"')
        end = xml.index(">", start) + 1
        xml = xml[:end] + geom + xml[end:]
    start = xml.index('<body name="gripper"')
    end = xml.index(">", start) + 1
    return xml[:end] + wrist + xml[end:]


def intrinsics() -> list[float]:
    """fx, fy, cx, cy of both cameras."""
    focal = HEIGHT / 2 / math.tan(math.radians(_FOVY) / 2)
    return [focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2]


class World:
    """The arm as it really stands. version: grows with every motion."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(scene_xml())
        self.model.vis.quality.offsamples = 0
        self.lock = threading.Condition()
        self.motors = dict.fromkeys(JOINTS, 0.0)  # degrees, as the motors report them
        self.version = 0
        self.handed_over: dict[str, int] = {}  # by camera
        self.enough: Callable[[], bool] = lambda: False  # whether to interrupt whoever reads the motors, as Ctrl+C does

    def move(self, goal: dict[str, float]) -> None:
        """Motors jump to where they are told, within the range of an SO-101."""
        with self.lock:
            self.motors |= {joint: float(np.clip(value, -60, 60)) for joint, value in goal.items()}
            self.version += 1

    def wait_for_cameras(self) -> dict[str, float]:
        """Positions of the motors, once every camera has handed over an image of them."""
        if self.enough():
            raise KeyboardInterrupt
        with self.lock:
            wanted = self.version
            self.lock.wait_for(lambda: all(seen >= wanted for seen in self.handed_over.values()), timeout=30)
            return dict(self.motors)

    def data_of(self, motors: dict[str, float]) -> mujoco.MjData:
        """The arm's real pose for what its motors report."""
        data = mujoco.MjData(self.model)
        for joint, value in motors.items():
            address = self.model.jnt_qposadr[self.model.joint(joint).id]
            data.qpos[address] = math.radians(value + OFFSETS[joint])
        mujoco.mj_forward(self.model, data)
        return data

    def camera_pose(self, camera: str, motors: dict[str, float]) -> np.ndarray:
        """`base_T_camera` (4, 4), OpenCV axes."""
        seen = self.data_of(motors).camera(camera)
        pose = np.eye(4)
        pose[:3, :3] = seen.xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = seen.xpos
        return pose

    def depth(self, renderer: mujoco.Renderer, camera: str, motors: dict[str, float]) -> np.ndarray:
        """True metres (H, W)."""
        renderer.update_scene(self.data_of(motors), camera)
        renderer.enable_depth_rendering()
        depth = renderer.render()
        renderer.disable_depth_rendering()
        return depth

    def renderer(self) -> mujoco.Renderer:
        return mujoco.Renderer(self.model, HEIGHT, WIDTH)


def true_calibration(world: World) -> Calibration:
    """What a perfect `pi05-geometry calibrate` would write."""
    arm = so101_like()
    for joint in arm.joints:
        joint.offset = np.radians(OFFSETS[joint.joint])
    motors = dict.fromkeys(JOINTS, 0.0)
    state = torch.zeros(1, 6, dtype=torch.float64)
    link = ForwardKinematics(arm, ["gripper"])(state)[0, 0].numpy()
    link_T_camera = np.linalg.inv(link) @ world.camera_pose("wrist", motors)
    cameras = {
        "front": CameraCalibration(intrinsics(), [WIDTH, HEIGHT], world.camera_pose("front", motors).tolist()),
        "wrist": CameraCalibration(
            intrinsics(), [WIDTH, HEIGHT], mount=Mount("arm", "gripper", link_T_camera.tolist())
        ),
    }
    for name, camera in cameras.items():
        camera.depth_scale = DEPTH_SCALE[name]
    return Calibration(cameras, {"arm": arm})


class MotorBus:
    """In place of `FeetechMotorsBus`. Motors report degrees."""

    world: World  # set by the test

    def __init__(self, port: str, motors: dict, calibration: dict | None = None) -> None:
        self.motors, self.is_connected, self.is_calibrated = motors, False, True

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self, disable_torque: bool = True) -> None:
        self.is_connected = False

    def configure_motors(self) -> None: ...

    def write(self, *_: object) -> None: ...

    @contextmanager
    def torque_disabled(self):
        yield

    def sync_read(self, name: str, num_retry: int = 0) -> dict[str, float]:
        assert name == "Present_Position"
        return self.world.wait_for_cameras()

    def sync_write(self, name: str, values: dict[str, float]) -> None:
        assert name == "Goal_Position"
        self.world.move(values)


def make_pyrealsense2(world: World) -> SimpleNamespace:
    """What LeRobot's RealSenseCamera calls of pyrealsense2."""

    class Config:
        def enable_device(self, serial: str) -> None:
            self.serial = serial

        def enable_stream(self, *_: object) -> None: ...

    class Pipeline:
        def start(self, config: Config) -> SimpleNamespace:
            self.name = SERIALS[config.serial]
            self.renderer: mujoco.Renderer | None = None
            self.rendered = -1
            world.handed_over[self.name] = -1
            stream = SimpleNamespace(fps=lambda: 30, width=lambda: WIDTH, height=lambda: HEIGHT)
            return SimpleNamespace(get_stream=lambda _: SimpleNamespace(as_video_stream_profile=lambda: stream))

        def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, SimpleNamespace]:
            # Being called again means that LeRobot has taken over the frame before.
            with world.lock:
                world.handed_over[self.name] = self.rendered
                world.lock.notify_all()
                version, motors = world.version, dict(world.motors)
            if self.renderer is None:  # a rendering context belongs to the thread that reads
                self.renderer = world.renderer()
            if version == self.rendered:
                time.sleep(0.02)
            self.renderer.update_scene(world.data_of(motors), self.name)
            color = self.renderer.render()
            counts = world.depth(self.renderer, self.name, motors) / DEPTH_SCALE[self.name]
            raw = np.where(counts < 65535, np.rint(counts), 0).astype(np.uint16)
            self.rendered = version
            image, depth = (SimpleNamespace(get_data=lambda array=array: array) for array in (color, raw))
            return True, SimpleNamespace(get_color_frame=lambda: image, get_depth_frame=lambda: depth)

        def stop(self) -> None: ...

    config = type("config", (Config,), {})
    return SimpleNamespace(
        config=config,
        pipeline=Pipeline,
        stream=SimpleNamespace(color="color", depth="depth"),
        format=SimpleNamespace(rgb8="rgb8", z16="z16"),
    )
