"""The cost of one message as bytes at known offsets, and as a message of rclpy.

python -m benchmarks.costs
"""

from __future__ import annotations

import sys
import timeit
from collections.abc import Callable

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from benchmarks.tracking import tracking
from hpid_ros.messages.joint_state import JointReader, JointStateTemplate

_CALLS, _REPEATS = 20_000, 7


def cost(call: Callable[[], object]) -> float:
    """Return the least time of a call over some repeats, in [us]."""
    return min(timeit.repeat(call, number=_CALLS, repeat=_REPEATS)) / _CALLS * 1e6


def main() -> int:
    """Measure and print."""
    joints = tracking().world.joints
    values = [0.1] * len(joints)
    state = JointStateTemplate(joints, position=True, effort=True).encode(
        1_000_000, position=values, effort=values
    )
    reader, template = JointReader(joints[-1]), JointStateTemplate(joints[-1:], effort=True)
    message = JointState(name=[joints[-1]], effort=[0.1])

    def find_in_message() -> float:
        found = deserialize_message(state, JointState)
        return float(found.position[found.name.index(joints[-1])])

    def set_and_serialise() -> bytes:
        message.effort[0] = 0.1
        return bytes(serialize_message(message))

    pairs = {
        "a joint's position out of a state of eight": (
            lambda: reader.read(state),
            find_in_message,
        ),
        "the bytes of a command": (
            lambda: template.encode(1_000_000, effort=(0.1,)),
            set_and_serialise,
        ),
    }
    print(f"{'':<44} {'bytes':>8} {'message':>8}")
    for what, (ours, theirs) in pairs.items():
        print(f"{what:<44} {cost(ours):5.2f} us {cost(theirs):5.2f} us")
    return 0


if __name__ == "__main__":
    sys.exit(main())
