"""``hpid doctor``: does this machine have what is needed, and what to do where it does not."""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from rich.text import Text

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.terminal import output_console
from hpid_bench.experiment.processes import SHARED_MEMORY, SHARED_MEMORY_ROOM
from hpid_ros.base.libraries import OPTIONAL, Library
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.simulation.settings import ENGINES

# Fine; something that not everybody needs is missing; controllers or the robot will not run.
GOOD, NOTE, BAD = "ok", "note", "bad"
_LOOKS = {GOOD: "green", NOTE: "yellow", BAD: "red"}
_PYTHONS = (3, 10), (3, 13)  # the oldest, and the newest that the suite was run with
_FOUND_WITHIN = 1.0  # [s]
_OPENGL = "apt install libegl1 libgl1-mesa-dri (or libosmesa6)"
_NO_ROS = "not tried: there is no ROS 2"
_RUNS_WITHIN = 60.0  # [s], a program of one line
_SETTINGS = (
    "ROS_DOMAIN_ID",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
)


class Finding(NamedTuple):
    state: str  # GOOD, NOTE or BAD
    found: str
    remedy: str = ""


def run(options: argparse.Namespace) -> int:
    """Look at one thing after the other, and print each as soon as it is known."""
    console = output_console()
    findings = {}
    for name, look in LOOKS.items():
        raise_if_interrupted()
        findings[name] = look()
        if not options.json:
            state, found, remedy = findings[name]
            line = Text.assemble((f"{state:5}", _LOOKS[state]), f" {name:13} {found}")
            console.print(line, soft_wrap=True)
            if remedy:
                console.print(f"      -> {remedy}", soft_wrap=True)
    if options.json:
        listed = [{"name": name, **each._asdict()} for name, each in findings.items()]
        print(json.dumps(listed, indent=2))
    return FAILED if any(each.state == BAD for each in findings.values()) else DONE


def python() -> Finding:
    version = ".".join(map(str, sys.version_info[:3]))
    found = f"{version} in {sys.prefix}"
    oldest, newest = (".".join(map(str, each)) for each in _PYTHONS)
    if not _PYTHONS[0] <= sys.version_info[:2] <= _PYTHONS[1]:
        return Finding(NOTE, found, f"known to work are {oldest} to {newest}")
    return Finding(GOOD, found)


def ros() -> Finding:
    """Whether the nodes can be imported, and whose ROS that is."""
    spec = find_spec("rclpy")
    if spec is None or spec.origin is None:
        return Finding(
            BAD,
            "rclpy is not there: no nodes",
            'source /opt/ros/jazzy/setup.bash, or without ROS: pip install "hpid_ros[ros]"',
        )
    place = Path(spec.origin).parent.parent
    distribution = os.environ.get("ROS_DISTRO", "")
    is_wheel = place.is_relative_to(sysconfig.get_path("purelib"))
    if is_wheel and distribution:
        return Finding(
            NOTE,
            f"wheels from PyPI in {place} hide the installed {distribution}",
            "pip uninstall ros-jazzy-rclpy, or do not source the installation",
        )
    if distribution not in ("", "jazzy"):
        return Finding(NOTE, f"{distribution} in {place}", "known to work is jazzy")
    return Finding(GOOD, f"{'wheels from PyPI' if is_wheel else 'jazzy'} in {place}")


def middleware() -> Finding:
    if find_spec("rclpy") is None:
        return Finding(BAD, _NO_ROS)
    asked = os.environ.get("RMW_IMPLEMENTATION", "")
    program = "import rclpy; rclpy.init(); print(rclpy.get_rmw_implementation_identifier())"
    done = _python(program)
    if done.returncode:
        return Finding(
            BAD,
            f"{asked or 'the default'} does not load: {_last(done.stderr)}",
            "unset RMW_IMPLEMENTATION, or install what it names; install ROS 2 again",
        )
    name = done.stdout.split()[-1]
    if not name.startswith("rmw_fastrtps"):
        return Finding(NOTE, name, "rates and delays of docs/performance.md are of Fast DDS")
    return Finding(GOOD, name)


def discovery() -> Finding:
    """Whether a controller in another process is found, and answers a state."""
    given = ", ".join(f"{name}={os.environ[name]}" for name in _SETTINGS if name in os.environ)
    if find_spec("rclpy") is None:
        return Finding(BAD, _NO_ROS)
    program = "from hpid_bench.live.discovery import time_to_answer; print(time_to_answer())"
    done = _python(program)
    if done.returncode:
        return Finding(BAD, _last(done.stderr), "see ROS 2 and middleware above")
    took = float(done.stdout.split()[-1])
    remedy = (
        f"{f'these settings count: {given}' if given else 'no setting of discovery is in the way'}"
        "; lo must be up, and a firewall let UDP through it (docs/faults.md)"
    )
    if math.isinf(took):
        return Finding(BAD, "two nodes did not find each other", remedy)
    found = f"a node in another process was found, and answered, within {took:.2f} s"
    if took > _FOUND_WITHIN:
        return Finding(NOTE, found, f"that is slow; {remedy}")
    return Finding(GOOD, found)


def shared_memory() -> Finding:
    """Whether the closed runs of ``hpid compare`` have room for their messages."""
    if not SHARED_MEMORY.is_dir() or not os.access(SHARED_MEMORY, os.W_OK):
        return Finding(
            BAD,
            f"{SHARED_MEMORY} is not there, or not writable: hpid compare and run need it",
            "mount a tmpfs there (docker run --ipc=private --shm-size=512m)",
        )
    free = shutil.disk_usage(SHARED_MEMORY).free
    found = f"{free / 2**20:.0f} MB free in {SHARED_MEMORY}"
    if free < SHARED_MEMORY_ROOM:
        remedy = "remove what fills it, or make it larger (docker run --shm-size=512m)"
        return Finding(BAD, found, remedy)
    return Finding(GOOD, found)


def real_time() -> Finding:
    """Whether ``realtime_priority`` would be granted."""
    program = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    kernel = "PREEMPT_RT kernel" if "PREEMPT_RT" in os.uname().version else "ordinary kernel"
    if _python(program).returncode:
        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        return Finding(
            NOTE,
            f"SCHED_FIFO is refused (ulimit -r: {limit}), {kernel}",
            "for a real arm: '@realtime - rtprio 98' in /etc/security/limits.d/, this user in "
            "that group, then log in again",
        )
    return Finding(GOOD, f"SCHED_FIFO is granted, {kernel}")


def engines() -> Finding:
    """Whether a simulated robot can be had."""
    found, failed = [], []
    for name in ENGINES:
        if find_spec(name) is None:
            failed.append(f"{name} is not installed")
        elif (done := _python(f"import {name}")).returncode:
            failed.append(f"{name}: {_last(done.stderr)}")
        else:
            found.append(name)
    remedy = f"pip install {'mujoco' if 'mujoco' not in found else 'pybullet'}"
    if not found:
        return Finding(BAD, "; ".join(failed) + ": no simulated robot", remedy)
    if failed:
        return Finding(NOTE, f"{', '.join(found)}; {'; '.join(failed)}", remedy)
    return Finding(GOOD, ", ".join(found))


def libraries() -> Finding:
    asked = {name: each for name, each in OPTIONAL.items() if name not in (*ENGINES, "rclpy")}
    missing: dict[Library, list[str]] = {}
    for name, library in asked.items():
        if find_spec(name) is None:
            missing.setdefault(library, []).append(name)
    if not missing:
        return Finding(GOOD, ", ".join(asked))
    needs = (f"{', '.join(names)}, for {each.purpose}" for each, names in missing.items())
    return Finding(
        NOTE,
        f"not installed: {'; '.join(needs)}",
        f"pip install {' '.join(each.package for each in missing)}",
    )


def drawing() -> Finding:
    """Whether ``hpid render`` can draw."""
    if find_spec("mujoco") is None:
        return Finding(NOTE, "not tried: hpid render draws with mujoco")
    program = "from hpid_ros.simulation.stage import gl_context; gl_context(64, 64).make_current()"
    done = _python(program)
    if done.returncode:
        found = _last(done.stderr).removesuffix(f": {_OPENGL}")
        return Finding(NOTE, f"hpid render cannot draw: {found}", _OPENGL)
    return Finding(GOOD, "hpid render can draw, no screen needed")


LOOKS: dict[str, Callable[[], Finding]] = {
    "Python": python,
    "ROS 2": ros,
    "middleware": middleware,
    "discovery": discovery,
    "shared memory": shared_memory,
    "real time": real_time,
    "engines": engines,
    "libraries": libraries,
    "OpenGL": drawing,
}


def _python(program: str) -> subprocess.CompletedProcess[str]:
    """Run a program in an interpreter of its own, which may crash or hang."""
    command = [sys.executable, "-c", program]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=_RUNS_WITHIN)
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"no end within {_RUNS_WITHIN:g} s")


def _last(text: str) -> str:
    """Return the message of the exception that ended a program."""
    lines = text.strip().splitlines() or [""]
    kind, _, message = lines[-1].partition(": ")
    return message if message and " " not in kind else lines[-1]
