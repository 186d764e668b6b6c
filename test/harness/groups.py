"""A group of joints without ROS: loops, bodies, and messages that take their time."""

import math
import random

import numpy as np

from harness.loops import pure_loop
from hpid_ros.messages.joint_state import JointPart
from hpid_ros.motion.joint_trajectory import PointArrays
from hpid_ros.nodes.parts.goal_follower import GoalFollower
from hpid_ros.nodes.parts.goals import GoalRequest, GroupSettings

MS = 1_000_000
SECOND = 1_000_000_000

THERE = {"shoulder": [0.0, 0.4, 1.0], "elbow": [0.0, -0.3, -0.5]}
TIMES = [0.0, 0.5, 1.0]


def goal(positions, times, velocities=None, accelerations=None, efforts=None, stamp_ns=0, **asked):
    """Return a goal: positions by joint, one for each of the times in [s]; the rest likewise."""
    none = np.full((len(times), len(positions)), np.nan)
    arrays = [
        none if each is None else np.array([each[name] for name in positions], float).T
        for each in (positions, velocities, accelerations, efforts)
    ]
    times_ns = np.round(np.array(times) * SECOND).astype(np.int64)
    return GoalRequest(tuple(positions), stamp_ns, times_ns, PointArrays(*arrays), **asked)


def at_rest(positions):
    """Return the velocities of a motion that rests at its ends, and passes between them."""
    velocities = {}
    for name, path in positions.items():
        slopes = np.gradient(np.array(path, float)) if len(path) > 1 else np.zeros(1)
        slopes[[0, -1]] = 0.0
        velocities[name] = slopes
    return velocities


class SimulatedGroup:
    """Joints of inertia 1 with their loops and one follower, all at 1 kHz.

    Whatever is told comes to each loop after a delay of its own, and states may come to the
    follower late, too. The encoders of some begin anew after a turn; their loops know it, and
    have parameters of their own.
    """

    def __init__(
        self,
        joints=("shoulder", "elbow"),
        facts=None,
        seed=0,
        most_delay=5,
        start_ns=0,
        wraps=None,
        **values,
    ):
        self.wraps = wraps or {}
        self.settings = GroupSettings.from_parameters(joints, facts or {}, values)
        self.follower = GoalFollower(self.settings)
        self.loops = [
            pure_loop(
                joint=joint,
                law="pid",
                **{"gains.p": 300.0, "gains.i": 1000.0, "gains.d": 30.0},
                velocity_source="measured",
                **({"encoder_wrap": math.tau, **self.wraps[joint]} if joint in self.wraps else {}),
            )
            for joint in joints
        ]
        self.position, self.velocity = [0.0] * len(joints), [0.0] * len(joints)
        self.stamp_ns = start_ns
        self.blocked, self.deaf, self.mute = set(), set(), set()
        self.is_behind = False  # whether more waits to be taken than the states
        self.results, self.told = [], []
        self.log = [[] for _ in joints]  # stamp, reference, its rate, position, effort
        self._draw, self._most = random.Random(seed), most_delay
        self._under_way = []

    def tell(self, told):
        """Send a trajectory to all loops."""
        if told is None:
            return
        self.told.append(told)
        for at, name in enumerate(told.names):
            due_ns = self.stamp_ns + self._draw.randint(0, self._most) * MS
            joint = self.settings.joints.index(name)
            self._under_way.append((due_ns, joint, told.column(at)))

    def note(self, outcome):
        if outcome is not None:
            if outcome.result is not None:
                self.results.append(outcome.result)
            self.tell(outcome.trajectory)

    def begin(self, request):
        begun = self.follower.begin(request)
        self.note(begun)
        return begun

    def cancel(self):
        self.note(self.follower.cancel())

    def run(self, seconds, until=None):
        """Let time pass, at most until a condition holds; return how long it was in [s]."""
        begun_ns = self.stamp_ns
        while self.stamp_ns < begun_ns + seconds * SECOND and not (until and until()):
            self.step()
        return (self.stamp_ns - begun_ns) / SECOND

    def step(self):
        self.stamp_ns += MS
        due = [each for each in self._under_way if each[0] <= self.stamp_ns]
        self._under_way = [each for each in self._under_way if each[0] > self.stamp_ns]
        for _, joint, column in due:
            if joint not in self.deaf:
                self.loops[joint].follow(column)
        parts = []
        for joint, loop in enumerate(self.loops):
            q, v = self.position[joint], self.velocity[joint]
            if self.settings.joints[joint] in self.wraps:
                q = math.remainder(q, math.tau)
            parts.append(JointPart(joint, q, v))
            effort = loop.step(self.stamp_ns, q, v)
            place = self.position[joint]
            self.log[joint].append((self.stamp_ns, *loop.following.reference, place, effort))
            if joint in self.blocked:
                self.velocity[joint] = 0.0
                continue
            self.velocity[joint] += effort * 1e-3
            self.position[joint] += self.velocity[joint] * 1e-3
        self.note(self.follower.take_state(self.stamp_ns, self.seen(parts)))
        if self.stamp_ns % (50 * MS) == 0:
            for joint, loop in enumerate(self.loops):
                if joint not in self.mute:
                    reference = loop.following.position
                    self.note(self.follower.take_reference(joint, self.stamp_ns, reference))
        if self.follower.misses and not self.is_behind:
            self.note(self.follower.confirm())

    def seen(self, parts):
        """Return what the follower sees of a state; to be replaced."""
        return parts

    def logged(self, joint):
        """Return a joint's log as columns: stamp [s], reference, velocity, position, effort."""
        columns = np.array(self.log[joint], float).T
        columns[0] /= SECOND
        return columns


def moving(stamp_ns=0, **asked):
    """Return a goal of a second that ends at rest at 1 and -0.5 rad."""
    return goal(THERE, TIMES, at_rest(THERE), stamp_ns=stamp_ns, **asked)


def started(**values):
    """Return a group that has begun to move."""
    group = SimulatedGroup(**values)
    group.run(0.2)
    group.begin(moving())
    return group
