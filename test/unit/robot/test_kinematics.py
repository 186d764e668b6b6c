"""Where links are, and joint positions that put them somewhere."""

import numpy as np
import pytest
from harness.places import URDF

from hpid_ros.base.errors import ReachError, RobotDescriptionError, SettingError
from hpid_ros.robot.description import LinkPose, RobotDescription
from hpid_ros.robot.kinematics import Kinematics, rotation_angles

ROBOT = RobotDescription.load(URDF)
ARM = tuple(f"arm_joint_{number}" for number in range(1, 7))
HOME = (0.0, -0.5, 1.8, 0.0, 1.2, 0.0)
SLIDE = """
<robot name="crane">
  <link name="base"/><link name="turret"/><link name="hook"/><link name="tip"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="turret"/>
    <origin xyz="0 0 1" rpy="0 0 0.3"/><axis xyz="0 0 2"/><limit effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="turret"/><child link="hook"/>
    <origin xyz="0.2 0 0" rpy="0.1 0 0"/><axis xyz="1 0 1"/>
    <limit lower="0" upper="2" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><parent link="hook"/><child link="tip"/>
    <origin xyz="0 0.1 -0.3" rpy="0 0.4 0"/></joint>
</robot>
"""


@pytest.fixture(scope="module")
def arm():
    return Kinematics(ROBOT, "payload")


def within(arm: Kinematics, generator: np.random.Generator) -> np.ndarray:
    """Return positions drawn within the limits."""
    return generator.uniform(arm.lower, arm.upper)


def test_the_joints_of_a_link_are_those_between_it_and_the_root(arm):
    assert arm.joints == ARM
    assert Kinematics(ROBOT, "wheel_left_link").joints == ("wheel_left_joint",)
    with pytest.raises(RobotDescriptionError, match="no joint moves"):
        Kinematics(ROBOT, "base_link")
    with pytest.raises(RobotDescriptionError, match="known: "):
        Kinematics(ROBOT, "hand")


@pytest.mark.parametrize("source", [URDF, SLIDE])
def test_many_poses_at_once_are_pinocchio_s(source):
    robot = RobotDescription.load(source)
    others = {"arm_joint_3": 0.7} if source is URDF else {}
    chosen = [name for name in ("arm_joint_5", *ARM[:2]) if name in robot.joints] or None
    link = Kinematics(robot, robot.last_link, chosen, others)
    generator = np.random.default_rng(1)
    positions = generator.uniform(0.0, 1.5, (50, len(link.joints)))
    poses = link.poses(positions)
    for row, position, rotation in zip(positions, *poses, strict=True):
        one = link.pose(row)
        assert position == pytest.approx(one.position, abs=1e-12)
        assert rotation == pytest.approx(one.rotation, abs=1e-12)


def test_the_jacobian_is_the_derivative_of_the_pose(arm):
    positions, step = np.array([0.3, -0.4, 1.5, 0.6, 0.9, -1.0]), 1e-6
    jacobian = arm.jacobian(positions)
    for column, direction in enumerate(np.eye(6)):
        ahead, behind = (
            arm.pose(positions + step * direction),
            arm.pose(positions - step * direction),
        )
        linear = (ahead.position - behind.position) / (2.0 * step)
        spin = (ahead.rotation - behind.rotation) / (2.0 * step) @ arm.pose(positions).rotation.T
        angular = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
        assert jacobian[:, column] == pytest.approx(np.hstack([linear, angular]), abs=1e-8)


def test_reachable_targets_are_reached_within_the_limits(arm):
    generator = np.random.default_rng(0)
    for _ in range(15):
        target = arm.pose(within(arm, generator))
        positions = arm.solve(target, HOME)
        assert (positions >= arm.lower).all()
        assert (positions <= arm.upper).all()
        found = arm.pose(positions)
        assert np.linalg.norm(found.position - target.position) < 1e-6
        assert rotation_angles(found.rotation[None], target.rotation[None])[0] < 1e-6


def test_the_same_question_has_the_same_answer(arm):
    target = arm.pose([2.5, 1.0, -2.0, 2.0, -1.5, 2.7])
    again = Kinematics(ROBOT, "payload")
    assert arm.solve(target, HOME).tobytes() == again.solve(target, HOME).tobytes()


def test_a_joint_at_its_limit_does_not_stop_the_others(arm):
    start = np.clip(HOME, arm.lower, arm.upper)
    start[4] = arm.upper[4]
    target = arm.pose([0.1, 0.4, 1.2, 0.0, 1.5, 0.0])
    found = arm.pose(arm.solve(target, start))
    assert found.position == pytest.approx(target.position, abs=1e-6)


def test_what_cannot_be_reached_is_told_with_how_far_it_is(arm):
    straight = arm.pose(np.zeros(6))
    above = straight.position + np.array([0.0, 0.0, 0.25])
    with pytest.raises(ReachError, match=r"payload cannot be put .* 0\.\d+ m and") as caught:
        arm.solve(LinkPose(above, straight.rotation), HOME)
    assert "\n" not in str(caught.value)


def test_positions_that_are_none_are_refused(arm):
    for bad in ([0.0] * 5, [np.nan] * 6):
        with pytest.raises(SettingError, match="6 finite numbers"):
            arm.pose(bad)


def test_small_and_large_angles_between_rotations_are_exact():
    for angle in (1e-9, 1e-4, 1.0, 3.0):
        turned = Kinematics(ROBOT, "wheel_left_link").pose([angle]).rotation
        assert rotation_angles(turned[None], np.eye(3)[None])[0] == pytest.approx(angle, rel=1e-6)
