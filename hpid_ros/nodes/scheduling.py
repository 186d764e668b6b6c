"""Real-time scheduling and CPU affinity of a node's process, where the system allows them."""

from __future__ import annotations

import os
from pathlib import Path

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.errors import SettingError
from hpid_ros.nodes.parameters import read_only

ORDINARY = "ordinary"


def schedule(node: Node) -> str:
    """Declare the parameters ``realtime_priority`` and ``cpu_affinity``, and do what they say.

    Both hold for every thread that the process has, so this is called when the middleware's are
    there: at the end of a node's construction. Children that a node starts do not inherit the
    priority. A priority that the system refuses is one line in the log, no end of the process.

    Args:
        node: The node.

    Returns:
        How the process is scheduled now, in a few words.

    Raises:
        SettingError: The priority is out of range, or there is no such CPU.
    """
    priority = int(
        read_only(node, "realtime_priority", 0, "SCHED_FIFO priority, 1 to 99; 0 for none")
    )
    if not 0 <= priority <= 99:
        raise SettingError(f"realtime_priority must lie in [0, 99], not {priority}")
    cpus = read_only(
        node, "cpu_affinity", Parameter.Type.INTEGER_ARRAY, "CPUs to run on; all if left out"
    )
    if cpus:
        _pin([int(cpu) for cpu in cpus])
    return _prioritise(node, priority) if priority else ORDINARY


def _threads() -> list[int]:
    return [int(entry.name) for entry in Path("/proc/self/task").iterdir()]


def _pin(cpus: list[int]) -> None:
    allowed = sorted(os.sched_getaffinity(0))
    if not set(cpus) <= set(allowed):
        raise SettingError(f"cpu_affinity must be among the CPUs {allowed}, not {cpus}")
    for thread in _threads():
        os.sched_setaffinity(thread, cpus)


def _prioritise(node: Node, priority: int) -> str:
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        for thread in _threads():
            os.sched_setscheduler(thread, policy, os.sched_param(priority))
    except PermissionError:
        node.get_logger().warning(
            f"realtime_priority {priority} is refused by the system and ordinary scheduling "
            f"stays: it needs CAP_SYS_NICE, or an rtprio limit of this user (ulimit -r) of at "
            f"least {priority}"
        )
        return f"{ORDINARY}, SCHED_FIFO {priority} was refused"
    return f"SCHED_FIFO {priority}"
