"""A planned brick task: within every limit, along straight lines, through every brick."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from harness.worlds import URDF, WHEELS

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.motion.bricks import BrickGoal, Placement, PlanOptions, TaskRobot, plan_bricks
from hpid_ros.motion.joint_trajectory import SplineReference
from hpid_ros.motion.references import planned_reference
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive, integrated
from hpid_ros.robot.kinematics import Kinematics, rotation_angles

pytestmark = pytest.mark.slow

ROBOT = RobotDescription.load(URDF)
ARM = Kinematics(ROBOT, "payload")
FOLDED = {"arm_joint_2": -0.6, "arm_joint_3": 1.9, "arm_joint_5": math.pi - 1.3}
AT_REST = [FOLDED.get(joint, 0.0) for joint in ARM.joints]
MOBILE = TaskRobot(ROBOT, DifferentialDrive.of(ROBOT, *WHEELS), FOLDED)
STANDING = replace(MOBILE, base=None)
SIZE = (0.07, 0.06, 0.08)
LIGHT = BrickGoal(
    "light", SIZE, Placement((0.9, 0.1, 0.18), 0.3), Placement((0.2, 0.8, 0.19), 1.2, math.pi / 2)
)
HEAVY = BrickGoal("heavy", SIZE, Placement((0.9, -0.1, 0.18)), Placement((0.4, 0.8, 0.2)))
NEAR = BrickGoal("near", SIZE, Placement((0.42, 0.1, 0.2)), Placement((0.4, -0.1, 0.2), 0.4))


def splines(trajectory):
    """Return each joint's reference from time 0."""
    return {
        joint: trajectory.column(joint).start(0, trajectory.points[0].positions[index])
        for index, joint in enumerate(trajectory.joint_names)
    }


def sampled(reference: SplineReference, times_ns):
    return np.array([reference.sample(int(time_ns)) for time_ns in times_ns])


def hand_in_odom(plan, times_ns, base=MOBILE.base):
    """Return where the plan has the hand: positions and rotations in odom."""
    references = splines(plan.trajectory)
    arm = np.column_stack([sampled(references[joint], times_ns)[:, 0] for joint in ARM.joints])
    poses = ARM.poses(arm)
    if base is None:
        return poses.positions, poses.rotations
    fine = np.arange(0, plan.trajectory.points[-1].time_from_start_ns + 1, 4_000_000)
    wheels = [sampled(references[joint], fine)[:, 0] for joint in WHEELS]
    at = np.searchsorted(fine, times_ns)
    positions, rotations = [], []
    for (x, y, heading), position, rotation in zip(
        integrated(base, *wheels)[np.minimum(at, len(fine) - 1)], *poses, strict=True
    ):
        c, s = math.cos(heading), math.sin(heading)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        positions.append(turn @ position + [x, y, 0.0])
        rotations.append(turn @ rotation)
    return np.array(positions), np.array(rotations)


@pytest.fixture(scope="module")
def plan():
    return plan_bricks(replace(MOBILE, opening=0.078), ARM, [LIGHT, HEAVY], AT_REST)


def test_every_joint_stays_within_its_limits_and_moves_without_a_jump(plan):
    end_ns = plan.trajectory.points[-1].time_from_start_ns
    times_ns = np.arange(0, end_ns, 10_000_000)
    for name, reference in splines(plan.trajectory).items():
        joint = ROBOT.joints[name]
        position, velocity, acceleration = sampled(reference, times_ns).T
        assert position.min() >= joint.lower
        assert position.max() <= joint.upper
        assert np.abs(velocity).max() <= joint.velocity
        # Continuous: within 10 ms each changes as its derivative says.
        means = [0.5 * (each[1:] + each[:-1]) for each in (velocity, acceleration)]
        assert np.abs(np.diff(position) - 1e-2 * means[0]).max() < 8e-5
        assert np.abs(np.diff(velocity) - 1e-2 * means[1]).max() < 4e-3
        assert velocity[0] == acceleration[0] == 0.0


def test_every_planned_pose_is_met_and_the_gripper_moves_at_each_brick_and_place(plan):
    expected = [LIGHT.pick, LIGHT.place, HEAVY.pick, HEAVY.place]
    assert [grip.is_closed for grip in plan.grips] == [True, False, True, False]
    assert [grip.brick for grip in plan.grips] == ["light", "light", "heavy", "heavy"]
    positions, rotations = hand_in_odom(
        plan, [each.time_ns for each in (*plan.poses, *plan.grips)]
    )
    count = len(plan.poses)
    for position, rotation, each in zip(
        positions[:count], rotations[:count], plan.poses, strict=True
    ):
        assert position == pytest.approx(each.pose.position, abs=1e-5)
        assert rotation_angles(rotation[None], each.pose.rotation[None])[0] < 1e-5
    positions, rotations = positions[count:], rotations[count:]
    gaps = (0.0, 0.003, 0.0, 0.003)
    for position, rotation, where, gap in zip(positions, rotations, expected, gaps, strict=True):
        assert position == pytest.approx(np.add(where.position, (0.0, 0.0, gap)), abs=1e-5)
        assert rotation[:, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
        across = math.atan2(rotation[1, 1], rotation[0, 1])
        quarter = math.remainder(across - where.yaw, math.pi / 2)
        assert quarter == pytest.approx(0.0, abs=1e-5)


def test_the_hand_goes_down_and_up_in_a_straight_line():
    plan = plan_bricks(STANDING, ARM, [NEAR], AT_REST)
    above, at_it, lifted = plan.poses[:3]
    times_ns = np.linspace(above.time_ns, lifted.time_ns, 2000).astype(np.int64)
    positions, rotations = hand_in_odom(plan, times_ns, None)
    assert np.abs(positions[:, :2] - above.pose.position[:2]).max() < 2e-4
    assert positions[:, 2].min() == pytest.approx(at_it.pose.position[2], abs=1e-6)
    assert rotation_angles(rotations, np.array([above.pose.rotation] * 2000)).max() < 1e-3


def test_the_base_moves_only_with_the_arm_folded(plan):
    references = splines(plan.trajectory)
    times_ns = np.arange(0, plan.trajectory.points[-1].time_from_start_ns, 20_000_000)
    wheels = [sampled(references[joint], times_ns)[:, 1] for joint in WHEELS]
    drives = np.abs(wheels).max(axis=0) > 1e-9
    arm = np.column_stack([sampled(references[joint], times_ns)[:, 0] for joint in ARM.joints])
    assert drives.mean() > 0.2
    assert np.abs(arm[drives] - AT_REST).max() < 1e-9


def test_a_brick_is_taken_across_its_narrow_side():
    long = replace(NEAR, size=(0.06, 0.15, 0.08))
    plan = plan_bricks(replace(STANDING, opening=0.078), ARM, [long], AT_REST)
    fingers = plan.poses[1].pose.rotation[:, 1]
    assert abs(fingers[0]) == pytest.approx(1.0)  # the brick's x, since its yaw is 0
    wide = replace(NEAR, size=(0.15, 0.15, 0.08))
    with pytest.raises(TrajectoryError, match=r"'near' is 0\.15 m wide.* opening of 0\.078 m"):
        plan_bricks(replace(STANDING, opening=0.078), ARM, [wide], AT_REST)


def test_what_is_out_of_reach_is_named_with_the_reach():
    far = replace(NEAR, name="far", place=Placement((1.4, 0.0, 0.2)))
    with pytest.raises(
        TrajectoryError, match=r"brick 'far', place: .*\(1\.400.* 0\.\d+ m"
    ) as error:
        plan_bricks(STANDING, ARM, [far], AT_REST)
    assert "\n" not in str(error.value)


def test_a_base_that_would_have_to_turn_its_wheels_too_fast_is_refused():
    with pytest.raises(TrajectoryError, match="rad/s"):
        plan_bricks(MOBILE, ARM, [LIGHT], AT_REST, PlanOptions(turn_speed=20.0))


def document(**reference):
    return {
        "robot": {
            "description": "robot",
            "base": dict(zip(("left_wheel", "right_wheel"), WHEELS, strict=True)),
            "initial_positions": FOLDED,
        },
        "scene": {
            "gripper": {"opening": 0.078},
            "bricks": {"b": {"size": [0.06, 0.06, 0.06], "position": [0.9, 0.0, 0.18], "mass": 1}},
        },
        "reference": {
            "kind": "bricks",
            "bricks": [{"brick": "b", "place": {"position": [0.2, 0.8, 0.18]}}],
        }
        | reference,
    }


def planned(values, robot=ROBOT):
    return planned_reference(values, "reference", lambda own: own.load(lambda name: robot))


def test_a_root_link_in_the_axle_is_as_high_above_the_ground_as_its_wheels_are_large():
    lowered = RobotDescription.load(ROBOT.xml.replace('<origin xyz="0 0 0.075"/>', "", 1))
    assert lowered.xml != ROBOT.xml
    ours, other = (planned(document(), robot).trajectory for robot in (lowered, ROBOT))
    assert len(ours.points) == len(other.points)
    for one, two in zip(ours.points, other.points, strict=True):
        assert one.positions == pytest.approx(two.positions, abs=1e-5)


def test_a_gripper_that_says_no_opening_has_the_simulated_ones():
    values = document()
    values["scene"] = {"bricks": {"b": {"size": [0.1] * 3, "position": [0.9, 0.0, 0.18]}}}
    with pytest.raises(TrajectoryError, match=r"the gripper's opening of 0\.078 m"):
        planned(values)


def test_an_arm_without_velocity_limits_gets_no_plan():
    robot = RobotDescription.load(re.sub(r' velocity="[^"]*"', "", ROBOT.xml))
    with pytest.raises(TrajectoryError, match=r"robot\.joints\.arm_joint_1\.velocity must give"):
        planned(document(), robot)


def test_a_document_says_the_whole_task():
    believed = {"brick": "b", "pick": {"yaw": 0.2}, "place": {"position": [0.2, 0.8, 0.18]}}
    trajectory, plan = planned(document(settle=0.5, bricks=[believed]))
    assert set(trajectory.joint_names) == {*WHEELS, *ARM.joints}
    (goal,) = plan.goals
    assert (goal.name, goal.pick) == ("b", Placement((0.9, 0.0, 0.18), 0.2))


def test_any_other_reference_is_what_it_was():
    section = {"kind": "step", "times": [0.0], "positions": {"arm_joint_1": [0.1]}}
    trajectory, plan = planned({"reference": section})
    assert plan is None
    assert trajectory.joint_names == ("arm_joint_1",)


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"bricks": [{"brick": "c", "place": {"position": [0, 0, 0]}}]}, "unknown brick 'c'"),
        ({"bricks": []}, "reference.bricks must name at least one brick"),
        ({"folded": {"elbow": 1.0}}, "unknown joint 'elbow'"),
        ({"arm_speed": 2.0}, r"reference\.arm_speed must be above 0 and at most 1, not 2\.0"),
    ],
)
def test_a_wrong_section_is_one_line(wrong, line):
    with pytest.raises(TrajectoryError, match=line) as error:
        planned(document(**wrong))
    assert "\n" not in str(error.value)
