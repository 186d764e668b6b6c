"""The control core: plain floats, no ROS, no files, no clocks."""

from hpid_ros.control.homogeneous_pid import Gains, HomogeneousPid, Pid
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.norms import CanonicalNorm, Norm, WeightedNorm
from hpid_ros.control.settings import LOOP_PARAMETERS, LoopSettings

__all__ = [
    "LOOP_PARAMETERS",
    "CanonicalNorm",
    "Gains",
    "HomogeneousPid",
    "JointLoop",
    "LoopSettings",
    "ModelTerm",
    "Norm",
    "Pid",
    "WeightedNorm",
]
