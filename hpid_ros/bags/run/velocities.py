"""Whether the robot of a bag measures velocities."""

from __future__ import annotations

from pathlib import Path

from hpid_ros.bags.columns.storage import Storage
from hpid_ros.bags.run.topics import choose_topics
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import MessageError
from hpid_ros.wire import JointReader


def measures_velocity(path: Path, joint: str) -> bool:
    """Tell whether the first state of a joint in a bag has a velocity."""
    reader = JointReader(joint)
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
        states = choose_topics(f"bag {path}", types, BagSelection()).states
        for batch in bag.batches(frozenset(states), lambda share: None):
            for index in range(len(batch.log_times_ns)):
                try:
                    sample = reader.read(batch.raw(index))
                except MessageError:
                    continue
                if sample is not None:
                    return sample.velocity is not None
    return False
