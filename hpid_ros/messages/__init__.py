"""Fixed-layout CDR codec of the two hot messages, states and commands (both JointState)."""

from hpid_ros.messages.joint_state import (
    JointStateFields,
    JointStateLayout,
    JointStateTemplate,
    decode_joint_state,
)
from hpid_ros.messages.readers import EffortReader, JointReader, JointSample

__all__ = [
    "EffortReader",
    "JointReader",
    "JointSample",
    "JointStateFields",
    "JointStateLayout",
    "JointStateTemplate",
    "decode_joint_state",
]
