"""Recorded runs computed anew: whether every command of a bag is what the law answers."""

from hpid_ros.replay.record import JointRecord
from hpid_ros.replay.replayed import replay_joint
from hpid_ros.replay.verdict import Difference, JointVerdict

__all__ = ["Difference", "JointRecord", "JointVerdict", "replay_joint"]
