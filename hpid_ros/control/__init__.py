"""The control core: plain floats, no ROS, no files, no clocks."""

from hpid_ros.control.gains import Gains
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.limited_law import ModelTerm
from hpid_ros.control.norms import CanonicalNorm, WeightedNorm
from hpid_ros.control.pid import Pid
from hpid_ros.control.settings.loop import LoopSettings
from hpid_ros.control.settings.table import LOOP_PARAMETERS

__all__ = [
    "LOOP_PARAMETERS",
    "CanonicalNorm",
    "Gains",
    "HomogeneousPid",
    "JointLoop",
    "LoopSettings",
    "ModelTerm",
    "Pid",
    "WeightedNorm",
]
