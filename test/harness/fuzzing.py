"""Messages as a broken robot, a broken driver or a stranger might send them."""

import math

import numpy as np
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from harness.poison import without_numbers
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_trajectory

MS = 1_000_000
NUMBERS = (math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e18, 0.0, -0.0, 1.0)
KINDS = (
    "good",
    "good",
    "number",
    "stamp",
    "names",
    "lengths",
    "bits",
    "cut",
    "bytes",
    "empty",
    "twice",
    "many",
    "order",
    "repeat",
)


class StateFuzzer:
    """Makes serialised JointStates, more or less about a joint, most of them wrong in one way."""

    def __init__(self, joint, seed):
        self.joint = joint
        self.draw = np.random.default_rng(seed)
        self.stamp_ns = 0
        self._others = [f"other_{k}" for k in range(10_000)]
        self._last = self.state([joint], self.stamp_ns, [0.0])

    def state(self, names, stamp_ns, positions, velocities=None):
        """Return a message as it should be."""
        template = JointStateTemplate(names, position=True, velocity=velocities is not None)
        return template.encode(
            stamp_ns, position=positions, velocity=() if velocities is None else velocities
        )

    def messages(self, count):
        """Yield so many messages, with a good one among every few."""
        kinds = self.draw.choice(KINDS, size=count)
        for kind in kinds:
            self.stamp_ns += int(self.draw.integers(0, 3)) * MS
            raw = getattr(self, f"_{kind}")()
            self._last = raw or self._last
            yield raw

    def _good(self):
        return self.state(["a", self.joint], self.stamp_ns, [0.0, self.draw.normal()], [0.0, 0.1])

    def _number(self):
        bad = NUMBERS[self.draw.integers(len(NUMBERS))]
        values = [0.1, bad] if self.draw.random() < 0.5 else [bad, 0.1]
        return self.state([self.joint], self.stamp_ns, values[:1], values[1:])

    def _stamp(self):
        jumps = (-1, -MS, -(10**9), 10**9, 10**15, -(10**15), 2**31 * 10**9 - 1 - self.stamp_ns)
        stamp_ns = self.stamp_ns + jumps[self.draw.integers(len(jumps))]
        raw = bytearray(self.state([self.joint], max(stamp_ns, -(2**31) * 10**9), [0.1]))
        if self.draw.random() < 0.3:
            raw[8:12] = (2**32 - 1).to_bytes(4, "little")  # nanoseconds of four seconds
        return bytes(raw)

    def _names(self):
        return self.state([f"{self.joint}x", ""], self.stamp_ns, [0.1, 0.2])

    def _twice(self):
        return self.state([self.joint, self.joint], self.stamp_ns, [0.1, 0.2])

    def _order(self):
        names = ["a", "b", self.joint, "c"]
        self.draw.shuffle(names)
        return self.state(names, self.stamp_ns, [0.1] * 4)

    def _many(self):
        if self.draw.random() > 0.02:  # they are long
            return self._order()
        names = [*self._others, self.joint]
        return self.state(names, self.stamp_ns, self.draw.normal(size=len(names)).tolist())

    def _lengths(self):
        names = [self.joint, "a"]
        raw = bytearray(self.state(names, self.stamp_ns, [0.1, 0.2], [0.1, 0.2]))
        at = bytes(raw).rindex((2).to_bytes(4, "little"))
        raw[at : at + 4] = int(self.draw.integers(0, 2**32)).to_bytes(4, "little")
        return bytes(raw)

    def _bits(self):
        raw = bytearray(self._last)
        for at in self.draw.integers(0, len(raw), size=min(3, len(raw))):
            raw[at] = int(self.draw.integers(256))
        return bytes(raw)

    def _cut(self):
        return self._last[: self.draw.integers(0, len(self._last))]

    def _bytes(self):
        return self.draw.bytes(int(self.draw.integers(0, 120)))

    def _empty(self):
        return b"" if self.draw.random() < 0.5 else self.state([], self.stamp_ns, [])

    def _repeat(self):
        return self._last


NAMES = (
    "",
    " ",
    "elbow\n",
    "élbow",
    "x" * 3000,
    "<b>",
    "'; --",
    "elbow\x00",
    "\u202eelbow",
    "0",
    "*",
)
STAMPS_NS = (0, 1, -1, MS, 10**9, 10**15, 2**62, -(10**18))
TRAJECTORY_KINDS = (
    "good",
    "good",
    "good",
    "number",
    "times",
    "stamp",
    "names",
    "lengths",
    "cut",
    "bits",
    "bytes",
    "counts",
    "large",
    "empty",
)


class TrajectoryFuzzer:
    """Makes serialised JointTrajectories, most of them wrong in one way."""

    def __init__(self, joints, seed):
        self.joints, self.draw, self.now_ns = list(joints), np.random.default_rng(seed), 0
        self._last = self._good()

    def messages(self, count):
        """Yield so many messages, none of which is empty."""
        for kind in self.draw.choice(TRAJECTORY_KINDS, size=count):
            raw = getattr(self, f"_{kind}")()
            self._last = raw or self._last
            yield raw or b"\0"

    def parts(self, names=None, points=None):
        """Return stamp, names, times and arrays of a motion within 1 rad and 2 s."""
        names = self.joints if names is None else names
        points = int(self.draw.integers(1, 6)) if points is None else points
        times_ns = np.cumsum(self.draw.integers(20, 400, size=points)) * MS
        shape = points, len(names)
        arrays = [self.draw.uniform(-1.0, 1.0, size=shape) for _ in range(4)]
        for k in range(1, 4):
            if self.draw.random() < 0.5:
                arrays[k] = np.full(shape, math.nan)
        stamp_ns = 0 if self.draw.random() < 0.5 else self.now_ns
        return stamp_ns, names, times_ns, arrays

    def _encoded(self, stamp_ns, names, times_ns, arrays):
        stamp_ns = max(min(stamp_ns, 2**31 * 10**9 - 1), -(2**31) * 10**9)
        return encode_trajectory(stamp_ns, names, times_ns, arrays)

    def _good(self):
        return self._encoded(*self.parts())

    def _number(self):
        stamp_ns, names, times_ns, arrays = self.parts()
        arrays[int(self.draw.integers(4))][-1, 0] = NUMBERS[int(self.draw.integers(len(NUMBERS)))]
        return self._encoded(stamp_ns, names, times_ns, arrays)

    def _times(self):
        stamp_ns, names, times_ns, arrays = self.parts()
        return self._encoded(stamp_ns, names, self.draw.permutation(times_ns) - MS, arrays)

    def _stamp(self):
        _, *rest = self.parts()
        choice = STAMPS_NS[int(self.draw.integers(len(STAMPS_NS)))]
        return self._encoded(self.now_ns + choice, *rest)

    def _names(self):
        other = NAMES[int(self.draw.integers(len(NAMES)))]
        names = [other, *self.joints, *self.joints[: int(self.draw.integers(2))]]
        return self._encoded(*self.parts([str(each) for each in self.draw.permutation(names)]))

    def _lengths(self):
        raw = bytearray(self._good())
        at = 4 * int(self.draw.integers(4, len(raw) // 4))
        raw[at : at + 4] = int(self.draw.integers(0, 9)).to_bytes(4, "little")
        return bytes(raw)

    def _cut(self):
        return self._last[: int(self.draw.integers(1, len(self._last) + 1))]

    def _bits(self):
        raw = bytearray(self._last)
        for at in self.draw.integers(0, len(raw), size=3):
            raw[at] = int(self.draw.integers(256))
        return bytes(raw)

    def _bytes(self):
        return self.draw.bytes(int(self.draw.integers(1, 200)))

    def _counts(self):
        count = int(self.draw.integers(1, 300))
        return without_numbers(count, count, self.joints)

    def _large(self):
        if self.draw.random() > 0.01:
            return self._good()
        return self._encoded(*self.parts(points=20_000))

    def _empty(self):
        return without_numbers(int(self.draw.integers(3)), 0)


class GoalFuzzer:
    """Makes goals of FollowJointTrajectory, most of them wrong in one way."""

    def __init__(self, joints, seed):
        self._trajectories = TrajectoryFuzzer(joints, seed)
        self.draw = self._trajectories.draw

    def goals(self, count):
        """Yield so many goals."""
        for _ in range(count):
            yield self._goal(str(self.draw.choice(GOAL_KINDS)))

    def _goal(self, kind):
        from control_msgs.action import FollowJointTrajectory
        from control_msgs.msg import JointTolerance

        fuzzer = self._trajectories
        goal = FollowJointTrajectory.Goal()
        if kind in ("good", "number", "times", "stamp", "names", "empty"):
            raw = getattr(fuzzer, f"_{kind}")()
            goal.trajectory = deserialize_message(raw, JointTrajectory)
        elif kind == "lengths":
            goal.trajectory = deserialize_message(fuzzer._good(), JointTrajectory)
            goal.trajectory.points[0].positions = [0.1] * int(self.draw.integers(0, 9))
        elif kind == "points":
            goal.trajectory.joint_names = fuzzer.joints
            goal.trajectory.points = [JointTrajectoryPoint()] * int(self.draw.integers(1, 2000))
        elif kind == "tolerance":
            goal.trajectory = deserialize_message(fuzzer._good(), JointTrajectory)
            number = NUMBERS[int(self.draw.integers(len(NUMBERS)))]
            name = NAMES[int(self.draw.integers(len(NAMES)))].replace("\0", "")
            goal.path_tolerance = [JointTolerance(name=name, position=number)]
            goal.goal_tolerance = [JointTolerance(name=fuzzer.joints[0], velocity=number)]
        return goal


GOAL_KINDS = (
    "good",
    "good",
    "number",
    "times",
    "stamp",
    "names",
    "empty",
    "lengths",
    "points",
    "tolerance",
)
