"""Forward kinematics against MuJoCo, and arms that are refused."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.geometry.kinematics import Arm, ForwardKinematics, Link, StateJoint
from lerobot_policy_pi05_geometry.geometry.rigid import check_rigid, compose, inverse
from tests.geometry.arms import mjcf_of, random_arm, random_state, so101_like
from tests.geometry.scenes import generator, random_pose, seeds

mujoco = pytest.importorskip("mujoco")


def mujoco_poses(arm: Arm, values: dict[str, float], links: list[str]) -> torch.Tensor:
    """`base_T_link` (L, 4, 4) float64 as MuJoCo computes it. values: of the joints, radians and metres."""
    model = mujoco.MjModel.from_xml_string(mjcf_of(arm))
    data = mujoco.MjData(model)
    for name, value in values.items():
        data.qpos[model.jnt_qposadr[model.joint(name).id]] = value
    mujoco.mj_kinematics(model, data)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(links), 1, 1)
    for number, link in enumerate(links):
        poses[number, :3, :3] = torch.from_numpy(data.body(link).xmat.reshape(3, 3).copy())
        poses[number, :3, 3] = torch.from_numpy(data.body(link).xpos.copy())
    return poses


def joint_values(arm: Arm, state: torch.Tensor) -> dict[str, float]:
    """Of one state (D,), computed one by one."""
    unit = {"degrees": math.pi / 180, "radians": 1.0, "metres": 1.0, "millimetres": 1e-3}
    return {j.joint: j.sign * unit[j.unit] * float(state[j.index]) + j.offset for j in arm.joints}


@given(seed=seeds, links=st.integers(1, 9), batch=st.integers(1, 4))
def test_poses_are_mujocos(seed, links, batch):
    random = generator(seed)
    arm = random_arm(random, links)
    arm.check("arm")
    state = random_state(random, arm, batch, width=links + 2)
    names = [link.name for link in arm.links]
    found = ForwardKinematics(arm, names)(state)
    assert found.dtype == torch.float32
    exact = ForwardKinematics(arm, names)(state.double())
    for row in range(batch):
        expected = mujoco_poses(arm, joint_values(arm, state[row]), names)
        assert (exact[row] - expected).abs().max() <= 1e-12
        assert (found[row] - expected).abs().max() <= 5e-6  # links up to 3 m from the base


def test_an_so101_is_placed_to_a_millionth_of_a_metre():
    arm = so101_like()
    state = random_state(generator(0), arm, 32, width=6)
    found = ForwardKinematics(arm, ["gripper"])(state)[:, 0]
    for row in range(32):
        expected = mujoco_poses(arm, joint_values(arm, state[row]), ["gripper"])[0]
        assert (found[row] - expected).abs().max() <= 1e-6
        check_rigid(found[row], "pose")


@given(seed=seeds)
def test_a_link_has_the_same_pose_whatever_else_is_asked_for(seed):
    random = generator(seed)
    arm = random_arm(random, 7)
    state = random_state(random, arm, 3, width=9)
    names = [link.name for link in arm.links]
    together = ForwardKinematics(arm, names[::-1])(state)
    for number, name in enumerate(names[::-1]):
        torch.testing.assert_close(ForwardKinematics(arm, [name])(state)[:, 0], together[:, number])


def test_a_joint_that_mimics_moves_with_the_other():
    links = [Link("base"), Link("a", "base", kind="prismatic", joint="j", axis=[1.0, 0.0, 0.0])]
    links.append(Link("b", "a", kind="prismatic", joint="j", axis=[0.0, 1.0, 0.0], scale=-2.0, shift=0.5))
    arm = Arm(links, [StateJoint("j", "j.pos", 1, "metres")])
    arm.check("arm")
    pose = ForwardKinematics(arm, ["b"])(torch.tensor([[9.0, 0.25]]))[0, 0]
    assert pose[:3, 3].tolist() == [0.25, 0.0, 0.0]
    assert ForwardKinematics(arm, ["b"])(torch.tensor([[9.0, 0.125]]))[0, 0, 1, 3] == 0.25


def test_unknown_joints_are_named_and_stay_at_zero():
    arm = so101_like()
    assert ForwardKinematics(arm, ["gripper"]).unknown_joints == []
    jaw = ForwardKinematics(arm, ["jaw"])
    assert jaw.unknown_joints == ["gripper"]
    state = random_state(generator(1), arm, 2, width=6)
    assert torch.equal(jaw(state), jaw(state + torch.tensor([0, 0, 0, 0, 0, 50.0])))


def test_a_state_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match=r"entries up to 4 of observation.state, which has 4"):
        ForwardKinematics(so101_like(), ["gripper"])(torch.zeros(1, 4))


def test_poses_that_are_no_number_stay_so():
    state = torch.zeros(2, 6)
    state[1, 2] = math.nan
    poses = ForwardKinematics(so101_like(), ["gripper"])(state)
    assert poses[0].isfinite().all()
    assert not poses[1].isfinite().all()


@given(seed=seeds)
def test_compose_and_inverse_are_the_matrix_ones(seed):
    random = generator(seed)
    first, second = torch.stack([random_pose(random), random_pose(random)]), random_pose(random)
    torch.testing.assert_close(compose(first, second), first @ second, atol=1e-14, rtol=0)
    torch.testing.assert_close(inverse(first), torch.linalg.inv(first), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda arm: arm.links.clear(), "has no links"),
        (lambda arm: arm.links.pop(0), "one root must come first"),
        (lambda arm: arm.links.append(Link("base")), "names of links"),
        (lambda arm: arm.links.append(Link("x", "nowhere")), "hangs on 'nowhere'"),
        (lambda arm: setattr(arm.links[1], "axis", [0.0, 0.0, 2.0]), "length 1"),
        (lambda arm: setattr(arm.links[1], "axis", [0.0, 1.0]), "three finite"),
        (lambda arm: setattr(arm.links[1], "origin", [[2.0, 0, 0, 0], *arm.links[0].origin[1:]]), "rigid"),
        (lambda arm: setattr(arm.links[1], "kind", "ball"), "kind must be one of"),
        (lambda arm: setattr(arm.links[1], "joint", ""), "need a joint"),
        (lambda arm: setattr(arm.joints[0], "joint", "knee"), "is in no link"),
        (lambda arm: setattr(arm.joints[0], "unit", "range_m100_100"), "--robot.use_degrees=true"),
        (lambda arm: setattr(arm.joints[0], "unit", "metres"), "degrees or radians"),
        (lambda arm: setattr(arm.joints[0], "sign", 0), "sign must be 1 or -1"),
        (lambda arm: setattr(arm.joints[0], "offset", math.nan), "offset finite"),
        (lambda arm: setattr(arm.joints[0], "joint", "elbow_flex"), "names a joint twice"),
    ],
)
def test_unusable_arms_are_refused(change, said):
    arm = so101_like()
    arm.check("left")
    change(arm)
    with pytest.raises(ValueError, match=said) as caught:
        arm.check("left")
    assert "'left'" in str(caught.value)
