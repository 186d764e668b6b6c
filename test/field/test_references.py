"""What people reported of trajectories on a topic, of turns and of ends, tried on a controller."""

import math

import numpy as np
import pytest
from harness.graph import NAME, Told
from harness.loops import loops_with
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.control import Gains
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot, minimum_jerk
from hpid_ros.nodes.core.middleware import RARE

MS = 1_000_000
SECOND = 1000 * MS
GAINS = {"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}


class Listener:
    """A controller that listens to trajectories, and answers the states of a joint at rest."""

    def __init__(self, harness):
        self.harness, self.told, self.references, self.k = harness, Told(harness), [], 0
        self.process = harness.start_controller(introspection_rate=-1.0, **GAINS)
        topic = f"/{NAME}/reference"
        harness.node.create_subscription(JointState, topic, self._on_reference, 100)

    def _on_reference(self, message):
        self.references.append(message.position[0])

    def begin(self):
        """Hold the joint at zero, with a clock and an integral that begin again."""
        for place in (0.125, 0.0):  # the first would not come of what was before
            self.send(Float64(data=place), RARE, f"{NAME}/setpoint", until=place)
        self.k = 0
        self.harness.commands.clear()
        self.step()

    def step(self, count=1):
        for _ in range(count):
            self.k += 1
            effort = self.harness.ask(self.k * MS, 0.0)
        return effort

    def send(self, message, quality, topic="joint_trajectory", until=0.0):
        """Publish a message to a controller that is matched, and step until it leads somewhere."""
        publisher = self.harness.node.create_publisher(type(message), topic, quality)
        self.harness.wait(publisher.get_subscription_count, what="the controller")
        publisher.publish(message)

        def is_taken():
            self.step()
            return bool(self.references) and abs(self.references[-1] - until) < 1e-9

        self.harness.wait(is_taken, what="the message to be taken")
        self.harness.node.destroy_publisher(publisher)

    def refuses(self, message, line, topic="joint_trajectory"):
        """Publish a message, and wait until it is refused with this in a line."""
        publisher = self.harness.node.create_publisher(type(message), topic, RARE)
        self.harness.wait(publisher.get_subscription_count, what="the controller")
        known = len(self.process.log.read_text())
        publisher.publish(message)

        def is_refused():
            told = self.told.newest().get("last fault", "")
            lines = [*self.process.log.read_text()[known:].splitlines(), told]
            return any("refused" in each and line in each for each in lines)

        self.harness.wait(is_refused, what=f"the refusal: {line}")
        self.harness.node.destroy_publisher(publisher)


@pytest.fixture(scope="module")
def started(module_harness):
    return Listener(module_harness)


@pytest.fixture
def listener(started):
    started.begin()
    return started


def trajectory(*points, names=("elbow",)):
    """Return a message; each point is a time in [s] and the values of its arrays."""
    message = JointTrajectory(joint_names=list(names))
    for seconds, values in points:
        point = JointTrajectoryPoint(**values)
        point.time_from_start.sec = int(seconds // 1)
        point.time_from_start.nanosec = round((seconds % 1) * 1e9)
        message.points.append(point)
    return message


def at(*places):
    return {"positions": list(places)}


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (trajectory(), "point"),
        (trajectory((0.1, {"velocities": [0.5]})), "positions"),
        (trajectory((0.0, at(0.1)), (0.0, at(0.2)), (0.0, at(0.3))), "time"),
        (trajectory((0.1, at(math.nan))), "nan"),
        (trajectory((0.1, at(0.1, 0.2))), "position"),
        (trajectory((0.1, at(0.1, 0.2)), names=["elbow", "elbow"]), "once"),
    ],
)
def test_a_trajectory_that_nobody_can_follow_is_refused_with_its_reason_and_moves_nothing(
    listener, message, line
):
    """An empty one is no stop: what stops a joint is a trajectory that ends where it stands."""
    listener.refuses(message, line)
    assert listener.step(20) == 0.0
    assert listener.references[-1] == 0.0


def test_a_setpoint_that_is_no_position_is_refused_and_moves_nothing(listener):
    listener.refuses(Float64(data=math.nan), "a setpoint must be finite", f"{NAME}/setpoint")
    assert listener.step(20) == 0.0


@pytest.mark.parametrize("durability", ["VOLATILE", "TRANSIENT_LOCAL"])
def test_a_trajectory_is_heard_whether_its_sender_latches_it_or_not(listener, durability):
    """`ros2 topic pub` and rqt do not, MoveIt's and our own senders may."""
    quality = QoSProfile(depth=1, durability=DurabilityPolicy[durability])
    there = {"positions": [0.3], "velocities": [0.0]}
    listener.send(trajectory((0.1, there)), quality, until=0.3)
    assert listener.step() > 0.0


def test_a_sender_that_offers_trajectories_best_effort_is_named_in_the_log(listener):
    """It is not heard, as by joint_trajectory_controller: half a trajectory is none."""
    quality = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = listener.harness.node.create_publisher(
        JointTrajectory, "joint_trajectory", quality
    )
    listener.harness.wait(
        lambda: "incompatible" in listener.process.log.read_text(), within=10, what="the line"
    )
    listener.harness.node.destroy_publisher(publisher)


def test_a_trajectory_of_other_joints_is_none_of_this_one(listener):
    listener.step(5)
    others = trajectory((0.1, at(1.0, 2.0)), names=["wrist", "shoulder"])
    publisher = listener.harness.node.create_publisher(JointTrajectory, "joint_trajectory", RARE)
    listener.harness.wait(publisher.get_subscription_count, what="the controller")
    known = len(listener.process.log.read_text())
    publisher.publish(others)
    assert listener.step(100) == 0.0
    there = {"positions": [7.0, 0.3], "velocities": [0.0, 0.0]}
    both = trajectory((0.1, there), names=["wrist", "elbow"])
    listener.send(both, RARE, until=0.3)
    assert "refused" not in listener.process.log.read_text()[known:]
    listener.harness.node.destroy_publisher(publisher)


def test_a_joint_is_held_at_the_end_of_its_trajectory_whatever_becomes_of_its_sender(listener):
    there = {"positions": [0.3], "velocities": [0.0]}
    listener.send(trajectory((0.1, there)), RARE, until=0.3)
    listener.step(100)
    assert set(listener.references[-60:]) == {0.3}
    listener.harness.wait(lambda: listener.told.says(lifecycle="active"), what="it to be active")


# --- turns, in the pure loop

settings, loop_on = loops_with(joint="elbow", law="pid", gains=Gains(100.0, 50.0, 20.0))


def course(loop, samples, start_ns=0, reads=lambda place: place):
    """Return the references of a loop whose joint is where its reference was."""
    place, places = loop.following.position if start_ns else 0.0, []
    for k in range(samples):
        loop.step(start_ns + k * MS, reads(place), 0.0)
        place = loop.following.position
        places.append(place)
    return np.array(places)


def test_a_trajectory_that_begins_on_the_other_side_of_half_a_turn_leads_the_right_way():
    """The joint is held at -pi, and its trajectory begins at pi, which is the same place."""
    loop = loop_on(encoder_wrap=math.tau, velocity_source="filtered")
    loop.step(0, -math.pi, 0.0)
    knots = (Knot(0, math.pi, 0.0), Knot(SECOND, 2.0, 0.0))
    loop.follow(Column("elbow", knots))
    places = []
    for k in range(1, 1300):
        place = loop.following.position if k > 1 else -math.pi
        loop.step(k * MS, math.remainder(place, math.tau))
        places.append(loop.following.position)
    assert max(places) <= -math.pi + 1e-6  # no hump to the wrong side
    assert places[-1] == pytest.approx(2.0 - math.tau)
    assert np.abs(np.diff(places)).max() < 2.5e-3


@pytest.mark.parametrize("turns", [1, 3, 7])
def test_trajectories_from_minus_to_plus_half_a_turn_go_round_and_round(turns):
    """Each one begins where the last one ended, a turn further on: nothing is unwound."""
    loop = loop_on(angle_wraparound=True)
    loop.step(0, -math.pi, 0.0)
    knots = (Knot(0, -math.pi, 6.0), Knot(round(math.tau / 6.0 * SECOND), math.pi, 6.0))
    places, now = [], 0
    for _ in range(turns):
        loop.follow(Column("elbow", knots))
        for _ in range(1047):
            now += MS
            loop.step(now, places[-1] if places else -math.pi, 6.0)
            places.append(loop.following.position)
    assert np.diff(places[1100:]).min(initial=0.0) > -1e-3
    assert places[-1] == pytest.approx(math.pi + math.tau * (turns - 1), abs=0.2)


@pytest.mark.parametrize("turns", [-5, -1, 0, 1, 2, 10])
def test_a_trajectory_any_number_of_turns_away_is_taken_to_where_the_joint_is(turns):
    loop = loop_on(angle_wraparound=True)
    loop.step(0, 0.2, 0.0)
    away = math.tau * turns
    loop.follow(Column("elbow", (Knot(0, 0.2 + away, 0.0), Knot(SECOND, 1.0 + away, 0.0))))
    places = []
    for k in range(1, 1500):
        loop.step(k * MS, loop.following.position if k > 1 else 0.2, 0.0)
        places.append(loop.following.position)
    assert places[-1] == pytest.approx(1.0)
    assert 0.2 - 1e-6 <= min(places) <= max(places) <= 1.0 + 1e-6


def test_ten_turns_are_ten_turns_where_turns_are_meant():
    loop = loop_on(multi_turn=True, encoder_wrap=math.tau, velocity_source="filtered")
    loop.step(0, 0.0)
    motion = minimum_jerk([0.0, 10.0], {"elbow": [0.0, 20.0 * math.pi]}).column("elbow")
    loop.follow(motion)
    for k in range(1, 10_200):
        loop.step(k * MS, math.remainder(loop.following.position, math.tau))
    assert loop.following.position == pytest.approx(20.0 * math.pi, abs=1e-3)
    assert abs(loop.error) < 0.05


def test_a_setpoint_beyond_a_stop_is_waited_for_at_the_stop_and_not_turned_round():
    """10 rad for a shoulder of [-0.5, 1.4] rad; 10 rad less a turn would be 3.7."""
    loop = loop_on(Setpoint(10.0), position_min=-0.5, position_max=1.4, velocity_max=2.0)
    place, velocity, highest = 0.0, 0.0, 0.0
    for k in range(8000):
        velocity += 1e-3 * loop.step(k * MS, place, velocity)
        place += 1e-3 * velocity
        highest = max(highest, place)
    assert place == pytest.approx(1.4, abs=5e-3)
    assert highest < 1.41
