"""The cost of eight controllers that wait for states."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.figures import Bound, Figure, Group, Source, middle
from benchmarks.processes import Scripts
from benchmarks.tracking import tracking
from hpid_bench.experiment.in_process import controllers_document, write_document
from hpid_bench.experiment.processes import NodeGroup, NodeProcess, closed_environment, own_domain
from hpid_ros.base.errors import RunError
from hpid_ros.base.names import controller_name
from hpid_ros.base.processes import raise_if_interrupted

LABEL = "hPID"

_WINDOWS, _WINDOWS_QUICK = 10, 2
_WINDOW = 1.0  # [s]
_WITHIN = 60.0  # [s] for all nodes to be up
_LOOK_EVERY = 0.05  # [s]
_PERCENT = 100.0


def group(quick: bool) -> Group:
    """Return the figure of the idle controllers."""
    windows = _WINDOWS_QUICK if quick else _WINDOWS
    figure = Figure(
        "idle.cpu",
        "% of a core",
        Source("waiting controllers", "cpu"),
        Source("empty nodes", "cpu"),
        "eight nodes that do nothing (the busiest of the eight on both sides)",
        (Bound("ours", most=1.0),),
    )
    return Group(
        {
            "waiting controllers": lambda: _controllers(windows),
            "empty nodes": lambda: _empty_nodes(windows),
        },
        (figure,),
    )


def _controllers(windows: int) -> Mapping[str, float]:
    """Measure controllers that listen to states which nobody publishes."""
    settings = tracking().controllers[LABEL]
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as name,
        own_domain() as domain,
        NodeGroup(closed_environment(domain), Path(name)) as nodes,
    ):
        file = Path(name) / "controllers.yaml"
        write_document(file, controllers_document(settings))
        arguments = ["--params-file", str(file), "-p", "certify:=false"]
        arguments += ["-p", "wait_for_command_subscribers:=0"]
        for each in settings:
            nodes.start(controller_name(each.joint), "joint_controller", arguments)
        _wait_until_listening(list(nodes.nodes.values()))
        return {"cpu": _busiest([node.pid for node in nodes.nodes.values()], windows)}


def _wait_until_listening(nodes: Sequence[NodeProcess]) -> None:
    waiting = {node.name: node for node in nodes}
    deadline = time.monotonic() + _WITHIN
    while waiting:
        for node in list(waiting.values()):
            if any(event["event"] == "listening" for event in node.read_events()):
                del waiting[node.name]
            elif node.process.poll() is not None:
                raise RunError(f"{node.name} has ended: {node.last_words()}")
        if time.monotonic() > deadline:
            raise RunError(f"waited {_WITHIN:g} s in vain for {', '.join(waiting)}")
        raise_if_interrupted()
        time.sleep(_LOOK_EVERY)


def _empty_nodes(windows: int) -> Mapping[str, float]:
    """Measure as many nodes without anything in them."""
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as name,
        own_domain() as domain,
        Scripts(closed_environment(domain), Path(name)) as scripts,
    ):
        for joint in tracking().world.joints:
            scripts.start(joint, "floor", ["--idle", joint])
        for joint in tracking().world.joints:
            scripts.result(joint, _WITHIN)
        pids = [process.pid for process in scripts.processes.values()]
        return {"cpu": _busiest(pids, windows)}


def _busiest(pids: Sequence[int], windows: int) -> float:
    """Return what the busiest of some processes takes, in percent of a core.

    Each process counts with its median over windows of a second, so that what is left of its
    start does not count.
    """
    shares: list[list[float]] = [[] for _ in pids]
    for _ in range(windows):
        begin, before = time.perf_counter(), [_cpu_time(pid) for pid in pids]
        while time.perf_counter() - begin < _WINDOW:
            raise_if_interrupted()
            time.sleep(_LOOK_EVERY)
        seconds = time.perf_counter() - begin
        for share, pid, used in zip(shares, pids, before, strict=True):
            share.append(_PERCENT * (_cpu_time(pid) - used) / seconds)
    return max(middle(share).median for share in shares)


def _cpu_time(pid: int) -> float:
    """Return the CPU time of all threads of a process, in [s].

    By its CPU-time clock, which counts nanoseconds where /proc counts ticks of ten milliseconds.
    Source: clock_getcpuclockid(3) and the kernel's posix-timers.h.
    """
    scheduler_clock = 2
    return time.clock_gettime((~pid << 3) | scheduler_clock)
