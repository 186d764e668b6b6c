"""Messages as a broken robot, a broken driver or a stranger might send them."""

import math

import numpy as np

from hpid_ros.messages.joint_state import JointStateTemplate

MS = 1_000_000
NUMBERS = (math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e18, 0.0, -0.0, 1.0)
KINDS = (
    *("good", "good", "number", "stamp", "names", "lengths", "bits", "cut", "bytes", "empty"),
    *("twice", "many", "order", "repeat"),
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
