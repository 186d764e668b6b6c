"""Commands of joint controllers merged into one: rounds by state stamp, silences, receiver."""

from hpid_ros.merging.merger import CommandMerger, Merged
from hpid_ros.merging.receiver import Receiver
from hpid_ros.merging.settings import MergedJoint, MergerSettings

__all__ = ["CommandMerger", "Merged", "MergedJoint", "MergerSettings", "Receiver"]
