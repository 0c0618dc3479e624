"""Arms for tests: one like the SO-101 (its joints' names, axes and sizes), as MJCF and URDF, and random ones."""

import math

import torch

from lerobot_policy_pi05_geometry.geometry.kinematics import Arm, Link, StateJoint
from tests.geometry.scenes import random_pose, uniform

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
STATE_NAMES = [f"{joint}.pos" for joint in JOINTS]

# Links of some 5 to 13 cm, three parallel axes in the middle, a roll at the wrist, and a jaw: an SO-101 without its meshes.
URDF = """<robot name="arm">
  <link name="base"/><link name="shoulder"/><link name="upper_arm"/><link name="lower_arm"/><link name="wrist"/>
  <link name="gripper"/><link name="jaw"/><link name="tip"/>
  <joint name="shoulder_pan" type="revolute"><parent link="base"/><child link="shoulder"/>
    <origin xyz="0 -0.045 0.054" rpy="0 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="shoulder_lift" type="revolute"><parent link="shoulder"/><child link="upper_arm"/>
    <origin xyz="0 -0.03 0.054" rpy="0.1 0 0"/><axis xyz="1 0 0"/></joint>
  <joint name="elbow_flex" type="revolute"><parent link="upper_arm"/><child link="lower_arm"/>
    <origin xyz="0 -0.028 0.112" rpy="1.2 0 0"/><axis xyz="1 0 0"/></joint>
  <joint name="wrist_flex" type="revolute"><parent link="lower_arm"/><child link="wrist"/>
    <origin xyz="0 0 0.135" rpy="0.3 0 0"/><axis xyz="1 0 0"/></joint>
  <joint name="wrist_roll" type="continuous"><parent link="wrist"/><child link="gripper"/>
    <origin xyz="0 0 0.06" rpy="0 0.05 0"/><axis xyz="0 0 2"/></joint>
  <joint name="gripper" type="revolute"><parent link="gripper"/><child link="jaw"/>
    <origin xyz="0.02 0 0.023" rpy="0 0 0.2"/><axis xyz="0 1 0"/></joint>
  <joint name="tip_fixed" type="fixed"><parent link="gripper"/><child link="tip"/><origin xyz="0 0 0.1"/></joint>
</robot>"""


def so101_like(state_unit: str = "degrees") -> Arm:
    """The arm of `URDF` with joints that the state has in LeRobot's order; the jaw's motor reports no angle."""
    import xml.etree.ElementTree as ET
    from pathlib import Path

    from lerobot_policy_pi05_geometry.robot.link_files import _from, _read_urdf

    links = _from(_read_urdf(ET.fromstring(URDF), Path("arm.urdf")), None, Path("arm.urdf"))
    joints = [StateJoint(joint, f"{joint}.pos", i, state_unit) for i, joint in enumerate(JOINTS[:5])]
    return Arm(links, joints)


def random_arm(random: torch.Generator, links: int) -> Arm:
    """A tree of links that hang anywhere, on joints of any kind and any axis."""
    made = [Link("root")]
    joints = []
    for number in range(links):
        parent = made[int(torch.randint(len(made), (), generator=random))].name
        kind = ("fixed", "revolute", "prismatic")[int(torch.randint(3, (), generator=random))]
        axis = torch.nn.functional.normalize(torch.randn(3, generator=random).double(), dim=0).tolist()
        link = Link(f"link{number}", parent, random_pose(random, 0.3).tolist(), kind, axis=axis)
        if kind != "fixed":
            link.joint = f"joint{number}"
            units = ("degrees", "radians") if kind == "revolute" else ("metres", "millimetres")
            unit = units[int(torch.randint(2, (), generator=random))]
            sign = 1 if torch.rand((), generator=random) < 0.5 else -1
            offset = float(uniform(random, -1.0, 1.0, 1))
            joints.append(StateJoint(link.joint, f"{link.joint}.pos", len(joints), unit, sign, offset))
        made.append(link)
    return Arm(made, joints, random_pose(random).tolist())


def mjcf_of(arm: Arm) -> str:
    """The same arm for MuJoCo, whose root body stands at `base_T_root`. Joint values are radians and metres."""

    def body(link: Link, pose: list[list[float]]) -> str:
        quaternion = _quaternion(torch.tensor(pose, dtype=torch.float64))
        position = " ".join(repr(row[3]) for row in pose[:3])
        axis = " ".join(map(repr, link.axis))
        kind = "hinge" if link.kind == "revolute" else "slide"
        joint = f'<joint name="{link.joint}" type="{kind}" axis="{axis}"/>' if link.joint else ""
        below = "".join(body(child, child.origin) for child in arm.links if child.parent == link.name)
        mass = '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'
        return f'<body name="{link.name}" pos="{position}" quat="{quaternion}">{joint}{mass}{below}</body>'

    return (
        '<mujoco><compiler angle="radian" autolimits="false"/><worldbody>'
        f"{body(arm.links[0], arm.base_T_root)}</worldbody></mujoco>"
    )


def _quaternion(pose: torch.Tensor) -> str:
    from scipy.spatial.transform import Rotation

    return " ".join(map(repr, Rotation.from_matrix(pose[:3, :3].numpy()).as_quat(scalar_first=True).tolist()))


def random_state(random: torch.Generator, arm: Arm, batch: int, width: int | None = None) -> torch.Tensor:
    """States (B, D) float32 of an arm's joints anywhere in their range, in the units of the arm."""
    width = width or 1 + max((joint.index for joint in arm.joints), default=-1)
    state = torch.zeros(batch, width)
    reach = {"degrees": 120.0, "radians": math.pi, "metres": 0.2, "millimetres": 200.0}
    for joint in arm.joints:
        state[:, joint.index] = uniform(random, -reach[joint.unit], reach[joint.unit], batch)
    return state
