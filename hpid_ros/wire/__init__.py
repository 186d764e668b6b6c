"""CDR codec: states and commands (both JointState), commands of groups, references."""

from hpid_ros.wire.group_commands import (
    DynamicJointStateTemplate,
    MultiArrayTemplate,
    decode_numbers,
)
from hpid_ros.wire.joint_state import (
    JointStateFields,
    JointStateLayout,
    JointStateTemplate,
    decode_joint_state,
)
from hpid_ros.wire.joint_trajectory import (
    MOST_MIXED_POINTS,
    MOST_POINTS,
    MixedTrajectory,
    TrajectoryArrays,
    decode_float64,
    decode_trajectory,
    encode_trajectory,
)
from hpid_ros.wire.readers import (
    EffortReader,
    GroupReader,
    JointPart,
    JointReader,
    JointSample,
    RobotReader,
    RobotSample,
)

__all__ = [
    "MOST_MIXED_POINTS",
    "MOST_POINTS",
    "DynamicJointStateTemplate",
    "EffortReader",
    "GroupReader",
    "JointPart",
    "JointReader",
    "JointSample",
    "JointStateFields",
    "JointStateLayout",
    "JointStateTemplate",
    "MixedTrajectory",
    "MultiArrayTemplate",
    "RobotReader",
    "RobotSample",
    "TrajectoryArrays",
    "decode_float64",
    "decode_joint_state",
    "decode_numbers",
    "decode_trajectory",
    "encode_trajectory",
]
