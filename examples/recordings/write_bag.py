"""A bag from numbers: two joints that come to their targets, as a recorder would write them.

    python examples/recordings/write_bag.py FOLDER

``ros2 bag info``, PlotJuggler, Foxglove and ``hpid metrics`` open it. The other examples of this
folder write their bags with it.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rosbags.rosbag2 import Reader

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.messages.writer import BagWriter
from hpid_ros.motion import step

JOINT_STATE, JOINT_TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
JOINTS, TARGETS = ["shoulder", "elbow"], np.array([0.5, -0.3])  # [rad]
DURATION_NS, PERIOD_NS = 2_000_000_000, 2_000_000


def write_bag(folder, rates=(4.0, 8.0)):
    """Write states, commands and the reference.

    Args:
        folder: The bag's folder, which must not exist.
        rates: How fast each error decays, in [1/s].
    """
    state = JointStateTemplate(JOINTS, position=True)
    command = JointStateTemplate(JOINTS, effort=True)
    wanted = step([0.0], {name: [each] for name, each in zip(JOINTS, TARGETS, strict=True)})
    with BagWriter(folder) as bag:
        states = bag.add_topic("/joint_states", JOINT_STATE)
        commands = bag.add_topic("/joint_commands", JOINT_STATE)
        references = bag.add_topic("/joint_trajectory", JOINT_TRAJECTORY)
        bag.write(references, 0, encode_joint_trajectory(wanted))
        for stamp_ns in range(0, DURATION_NS, PERIOD_NS):
            error = TARGETS * np.exp(-np.array(rates) * stamp_ns * 1e-9)
            bag.write(states, stamp_ns, state.encode(stamp_ns, position=list(TARGETS - error)))
            bag.write(commands, stamp_ns, command.encode(stamp_ns, effort=list(5.0 * error)))


def main(folder):
    """Write a bag and say what is in it."""
    write_bag(folder)
    with Reader(folder) as bag:
        for name, topic in bag.topics.items():
            print(f"{name:18} {topic.msgtype:36} {topic.msgcount:5} messages")


if __name__ == "__main__" and len(sys.argv) > 1:
    main(Path(sys.argv[1]))
elif __name__ == "__main__":
    with TemporaryDirectory() as folder:
        main(Path(folder) / "bag")
