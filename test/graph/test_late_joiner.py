"""A controller that comes late carries on with the motion, and nobody else notices."""

import itertools
import signal

import pytest
from harness.graph import ros_arguments
from harness.trajectories import column_from_bytes, from_message
from hypothesis import given
from hypothesis import strategies as st
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.motion import JointTrajectory, TrajectoryPoint, minimum_jerk
from hpid_ros.nodes.core.middleware import LATCHED

MS = 1_000_000


@st.composite
def motions(draw):
    """A trajectory of stamp 0, when it started, and when its copy is taken over."""
    gaps = draw(st.lists(st.integers(1, 3000 * MS), min_size=1, max_size=5))
    time_ns = draw(st.sampled_from([0, 0, 5 * MS]))
    fields = draw(st.integers(0, 2))
    numbers = st.floats(-3.0, 3.0)
    points = []
    for gap in [0, *gaps]:
        time_ns += gap
        position, velocity, acceleration = (draw(numbers),), (draw(numbers),), (draw(numbers),)
        points.append(
            TrajectoryPoint(
                time_ns, position, velocity if fields else (), acceleration * (fields == 2)
            )
        )
    start_ns = draw(st.sampled_from([0, 1, MS, 1_700_000_000 * 10**9 + 123]))
    taken_ns = start_ns + points[0].time_from_start_ns + draw(st.integers(0, 5000 * MS))
    return JointTrajectory(("elbow",), tuple(points)), start_ns, taken_ns


@given(motions(), st.lists(st.integers(0, 10_000 * MS), max_size=20), st.floats(-3.0, 3.0))
def test_taking_the_started_copy_over_changes_no_bit_of_the_reference(motion, later, elsewhere):
    trajectory, start_ns, taken_ns = motion
    reference = trajectory.column("elbow").start(start_ns, 0.25)
    copy = column_from_bytes(encode_joint_trajectory(trajectory.started(start_ns)), "elbow")
    again = copy.start(taken_ns, elsewhere)
    for stamp_ns in (taken_ns, *(taken_ns + each for each in later)):
        assert again.sample(stamp_ns) == reference.sample(stamp_ns)


def test_points_before_the_stamp_are_for_motions_that_have_a_stamp():
    points = (TrajectoryPoint(-1, (0.0,)), TrajectoryPoint(MS, (1.0,)))
    assert JointTrajectory(("elbow",), points, stamp_ns=1).points == points
    with pytest.raises(TrajectoryError, match="from 0 ns on; point 0 has -1 ns"):
        JointTrajectory(("elbow",), points)
    with pytest.raises(TrajectoryError, match="from -1 ns on; point 0 has -2 ns"):
        JointTrajectory(("elbow",), (TrajectoryPoint(-2, (0.0,)),), stamp_ns=1)


def start_publisher(harness, folder):
    """Return the process of a publisher, and the trajectories that come from now on."""
    file, received = folder / "motion.yaml", []
    file.write_text(
        "reference: {kind: minimum_jerk, times: [0.0, 2.0], positions: {elbow: [0.0, 1.0]}}"
    )
    harness.node.create_subscription(
        JointTrajectoryMessage, "joint_trajectory", received.append, LATCHED
    )
    arguments = ros_arguments(reference_file=file)
    return harness.processes.start("reference", "trajectory_publisher", arguments), received


@pytest.mark.parametrize("start_ns", [0, 7_000 * MS])
def test_the_publisher_latches_the_start_once_the_motion_has_begun(harness, tmp_path, start_ns):
    started, received = start_publisher(harness, tmp_path)
    process = started.process
    harness.wait(lambda: received, what="the trajectory")
    motion = minimum_jerk([0.0, 2.0], {"elbow": [0.0, 1.0]})
    assert from_message(received[0]) == motion
    harness.wait(lambda: harness.states.get_subscription_count() == 1, what="the publisher")
    template = JointStateTemplate(["elbow"], position=True)
    process.send_signal(signal.SIGSTOP)  # it is slow, and a robot in lock-step is not
    for k in range(50):
        harness.states.publish(template.encode(start_ns + k * MS, position=[0.0]))
    process.send_signal(signal.SIGCONT)
    harness.wait(lambda: len(received) > 1, what="the started trajectory")
    assert from_message(received[1]) == motion.started(start_ns)
    harness.wait(lambda: harness.states.get_subscription_count() == 0, what="it to leave")
    late = []
    harness.node.create_subscription(
        JointTrajectoryMessage, "joint_trajectory", late.append, LATCHED
    )
    harness.wait(lambda: late, what="the latched trajectory")
    assert from_message(late[0]) == motion.started(start_ns)
    assert len(received) == 2


def test_where_states_come_already_all_are_told_the_same_start(harness, tmp_path):
    """Not each its own: that of the state that it had when the trajectory came."""
    process, received = start_publisher(harness, tmp_path)
    template, count = JointStateTemplate(["elbow"], position=True), itertools.count()

    def is_received():
        harness.states.publish(template.encode(next(count) * MS, position=[0.0]))
        return received

    def is_started():
        return is_received() and from_message(received[-1]).stamp_ns

    harness.wait(is_started, what="the trajectory")
    told = from_message(received[-1])
    assert told == minimum_jerk([0.0, 2.0], {"elbow": [0.0, 1.0]}).started(told.stamp_ns)
    harness.wait(lambda: harness.states.get_subscription_count() == 0, what="it to leave")
    assert len(received) <= 2
    if process.read_events()[0]["event"] == "under way":  # it had heard states within its looks
        assert told.stamp_ns > 50 * MS
