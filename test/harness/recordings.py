"""Recordings of one joint as ROS 2 has them, written by rosbags alone."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from harness.bags import JOINT_STATE, S
from hpid_ros.messages.selection import BagSelection
from hpid_ros.metrics import Measuring, measure

T0 = 1_700_000_000 * S
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
DOF, DOFS = "control_msgs/msg/SingleDOFState", "control_msgs/msg/MultiDOFStateStamped"
PID_STATE, STRING = "control_msgs/msg/PidState", "std_msgs/msg/String"
POINTS = ("reference", "feedback", "error", "output")


def store():
    types = get_typestore(Stores.ROS2_JAZZY)
    point, multi = "trajectory_msgs/JointTrajectoryPoint", "trajectory_msgs/MultiDOFJoint"
    text = "std_msgs/Header header\nstring[] joint_names\n"
    text += "".join(f"{point} {name}\n" for name in POINTS) + "string[] multi_dof_joint_names\n"
    text += "".join(f"{multi}TrajectoryPoint multi_dof_{name}\n" for name in POINTS)
    types.register(get_types_from_msg(text + "float64 speed_scaling_factor\n", CONTROLLER_STATE))
    numbers = ("reference", "feedback", "feedback_dot", "error", "error_dot", "time_step")
    text = "string name\n" + "".join(f"float64 {name}\n" for name in (*numbers, "output"))
    types.register(get_types_from_msg(text, DOF))
    numbers = ("error", "error_dot", "p_error", "i_error", "d_error", "p_term", "i_term", "d_term")
    text = "std_msgs/Header header\nbuiltin_interfaces/Duration timestep\n"
    text += "".join(f"float64 {name}\n" for name in (*numbers, "i_max", "i_min", "output"))
    types.register(get_types_from_msg(text, PID_STATE))
    text = "std_msgs/Header header\ncontrol_msgs/SingleDOFState[] dof_states\n"
    types.register(get_types_from_msg(text, DOFS))
    return types


STORE = store()


def made(kind, *fields):
    return bytes(STORE.serialize_cdr(STORE.types[kind](*fields), kind))


def header(stamp_ns):
    time = STORE.types["builtin_interfaces/msg/Time"](*divmod(int(stamp_ns), S))
    return STORE.types["std_msgs/msg/Header"](time, "")


def joint_state(stamp_ns, names, position=(), velocity=(), effort=()):
    arrays = (np.array(each, float) for each in (position, velocity, effort))
    return made(JOINT_STATE, header(stamp_ns), list(names), *arrays)


def report(stamp_ns, reference):
    """Return what a joint_trajectory_controller reports of j1."""
    none, time = np.zeros(0), STORE.types["builtin_interfaces/msg/Duration"](0, 0)
    point = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    multi = STORE.types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], time)
    points = [point(np.array([reference]), none, none, none, time)]
    points += [point(none, none, none, none, time)] * 3
    return made(CONTROLLER_STATE, header(stamp_ns), ["j1"], *points, [], *[multi] * 4, 1.0)


def pid_report(stamp_ns, **dofs):
    """Return what a pid_controller reports: reference, feedback and output by joint."""
    dof = STORE.types[DOF]
    states = [dof(k, r, y, 0.0, r - y, 0.0, 0.01, u) for k, (r, y, u) in dofs.items()]
    return made(DOFS, header(stamp_ns), states)


def write(path: Path, kinds, log) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            name: writer.add_connection(name, kind, typestore=STORE)
            for name, kind in kinds.items()
        }
        for name, log_time_ns, raw in sorted(log, key=lambda each: each[1]):
            writer.write(topics[name], int(log_time_ns), raw)
    return path


def states(positions, efforts=None, rate=100):
    """Return the states of j1 at an even rate, received 0.2 ms after their stamps."""
    log = []
    for k, position in enumerate(positions):
        stamp_ns = T0 + k * S // rate
        effort = () if efforts is None else (efforts[k],)
        log.append(
            (
                "/joint_states",
                stamp_ns + 2e5,
                joint_state(stamp_ns, ["j1"], [position], (), effort),
            )
        )
    return log


def reports(topic, references, rate=100, first=0):
    return [
        (topic, T0 + k * S // rate + 3e5, report(T0 + k * S // rate, reference))
        for k, reference in enumerate(references, first)
    ]


def integral(t, y):
    return float(np.sum(np.diff(t) * (y[1:] + y[:-1])) / 2.0)


def itae(t, e):
    return integral(t, t * np.abs(e))


def j1(bag, **selection):
    return measure(bag, how=Measuring(BagSelection(**selection)))
