"""A node's process and its own parameters: scheduling, launch, end, DDS security.

``ros2 launch`` ends its processes on SIGINT; SIGTERM and SIGKILL end it alone, and what it started
would go on driving the robot. This package's launch files name themselves to what they start, and
the kernel tells it when they are gone.

With ``ROS_SECURITY_ENABLE=true`` a middleware that was built without DDS security starts all the
same, unprotected and without a word. The wheels of ROS on PyPI are built so.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import math
import mmap
import os
import signal
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError
from hpid_ros.base.records import (
    AnyRecord,
    ParameterSpec,
    Record,
    from_parameters,
    parameters_of,
    quantity,
)
from hpid_ros.base.units import of_slide


def descriptor(spec: ParameterSpec, description: str, *, read_only: bool) -> ParameterDescriptor:
    shown = ParameterDescriptor(
        description=description,
        read_only=read_only,
        additional_constraints=_constraints(spec),
    )
    if spec.slider:
        low, high = spec.slider
        shown.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    return shown


def _constraints(spec: ParameterSpec) -> str:
    if spec.choices:
        return f"one of: {', '.join(spec.choices)}"
    if isinstance(spec.default, float) and math.isfinite(spec.minimum + spec.maximum):
        return f"from {spec.minimum:g} to {spec.maximum:g}"
    return ""


def declare(
    node: Node,
    specs: Iterable[ParameterSpec],
    read_only: Iterable[str] = (),
    *,
    is_slide: bool = False,
) -> None:
    """Declare parameters from their records; for a prismatic joint in m and N."""
    fixed = set(read_only)
    for spec in specs:
        text = of_slide(spec.description) if is_slide else spec.description
        shown = descriptor(spec, text, read_only=spec.name in fixed)
        node.declare_parameter(spec.name, spec.default, shown)


_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple[str, ...]: Parameter.Type.STRING_ARRAY,
    tuple[int, ...]: Parameter.Type.INTEGER_ARRAY,
    tuple[float, ...]: Parameter.Type.DOUBLE_ARRAY,
}


def read(node: Node, kind: type[AnyRecord], **defaults: Any) -> AnyRecord:
    """Declare a record's parameters, fixed when the node starts, and return what they say."""
    values = {}
    for name, spec in parameters_of(kind).items():
        default = defaults.get(spec.path, spec.default)
        values[name] = read_one(node, spec, default)
    return from_parameters(kind, values)


def read_one(node: Node, spec: ParameterSpec, default: object = None, note: str = "") -> Any:
    """Declare one parameter, fixed when the node starts, and return its value; None if not given.

    Without a default its type alone is declared.
    """
    shown = descriptor(spec, spec.description + note, read_only=True)
    start = _TYPES[spec.field.kind] if default is None else default
    start = list(start) if isinstance(start, tuple) else start
    return node.declare_parameter(spec.name, start, shown).value


@dataclass(frozen=True)
class Scheduling(Record):
    """How the threads of a node's process are scheduled."""

    realtime_priority: int = quantity(
        "SCHED_FIFO priority, 1 to 99; 0 for none", default=0, least=0, most=99
    )
    cpu_affinity: tuple[int, ...] | None = quantity(
        "CPUs to run on; all if left out", default=None
    )


ORDINARY = "ordinary"


def schedule(node: Node) -> str:
    """Declare the parameters ``realtime_priority`` and ``cpu_affinity``, and do what they say.

    Both hold for every thread that the process has, so this is called when the middleware's are
    there: at the end of a node's construction. Children that a node starts do not inherit the
    priority. A priority that the system refuses is one line in the log, no end of the process.
    """
    asked = read(node, Scheduling)
    if asked.cpu_affinity:
        _pin(asked.cpu_affinity)
    return _prioritise(node, asked.realtime_priority) if asked.realtime_priority else ORDINARY


def _threads() -> list[int]:
    return [int(entry.name) for entry in Path("/proc/self/task").iterdir()]


def _pin(cpus: Sequence[int]) -> None:
    allowed = sorted(os.sched_getaffinity(0))
    if not set(cpus) <= set(allowed):
        raise SettingError(f"cpu_affinity must be among the CPUs {allowed}, not {list(cpus)}")
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


LAUNCH = "HPID_ROS_LAUNCH"
"""Environment variable: the process id of the launch."""

_PR_SET_PDEATHSIG = 1


def end_with_the_launch() -> None:
    """Get SIGTERM when the launch has ended, however that came about; on Linux."""
    launch = os.environ.get(LAUNCH)
    if launch is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if not Path("/proc", launch).exists():  # it was gone before
        os.kill(os.getpid(), signal.SIGTERM)


_TORN_DOWN_WITHIN = 15.0  # [s]


def end_in_time() -> None:
    """Have this process end with code 1, and print where it stands, if it takes long from here on.

    To be called when every node has been closed: what is left is the middleware's.
    """
    _flush()
    faulthandler.dump_traceback_later(_TORN_DOWN_WITHIN, exit=True)


def end(code: int) -> NoReturn:
    """End this process at once, without what the interpreter and the libraries do at their ends.

    There Python's objects, the statics of Fast DDS and threads that are still running go in no
    order: about once in a thousand ends on a busy machine a process crashed or stood still for
    ever, with all of its work done.
    """
    _flush()
    os._exit(code)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # nobody reads it any more
            stream.flush()
    ctypes.CDLL(None).fflush(None)


_MIDDLEWARES = ("libfastrtps.so", "libfastdds.so")
_MARK = b"dds.sec.auth.plugin"  # the property that names the authentication plugin


def warn_if_unprotected(node: Node) -> None:
    """Log one warning when security was asked for and the loaded Fast DDS has none."""
    if os.environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        return
    library = _loaded_middleware()
    if library is None:
        return
    with library.open("rb") as stream, mmap.mmap(stream.fileno(), 0, prot=mmap.PROT_READ) as data:
        has_security = data.find(_MARK) >= 0
    if not has_security:
        node.get_logger().warning(
            "ROS_SECURITY_ENABLE is set, but this Fast DDS was built without security: nothing is "
            "authenticated or encrypted, and anybody on the network can command this node"
        )


def _loaded_middleware(maps: Path = Path("/proc/self/maps")) -> Path | None:
    """Return the Fast DDS library of this process; None when another middleware is loaded."""
    for line in maps.read_text().splitlines():
        path = Path(line.rpartition(" ")[2])
        if path.name.startswith(_MIDDLEWARES):
            return path
    return None
