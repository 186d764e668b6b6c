"""Surroundings of a disturbed graph: the transports of a robot, a network of its own.

On a robot the nodes find each other by UDP and talk through shared memory. Experiments have
shared memory alone, the closed mode, and there Fast DDS can lose its discovery for good: when a
process is killed or frozen, all others open the common port anew, but keep their former places in
the list by which a listener's death is noticed (``SharedMemManager::Listener::operator=`` does
not move ``listener_index_``; so in 2.14.5 and in all later versions seen). Dead listeners then
stay unnoticed, the port fills up, and a process that is started later is found by nobody.
docs/faults.md tells more.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.processes import ROOT
from hpid_ros.experiment.processes import closed_environment, own_domain

_OPTIONS = ((), ("--user", "--map-current-user", "--keep-caps"))  # of root, and of all others


@dataclass(frozen=True)
class Surroundings:
    """What processes of one graph need to find each other, and nobody else.

    Attributes:
        environment: Their whole environment.
        prefix: Command in front of each of theirs.
        is_closed: Whether they have no network sockets at all.
    """

    environment: dict[str, str]
    prefix: tuple[str, ...]
    is_closed: bool


@contextmanager
def own_surroundings() -> Iterator[Surroundings]:
    """Make a network of its own; where the system permits none, it is the closed mode.

    Raises:
        RunError: All ROS domains are taken.
    """
    with own_domain() as domain:
        environment = closed_environment(domain)
        holder = _new_network()
        if holder is None:
            print(
                "this system permits no network namespace: the graph runs in the closed mode, "
                "where a restarted process may not be found again",
                file=sys.stderr,
            )
            yield Surroundings(environment, (), is_closed=True)
            return
        try:
            yield _in_network(holder, environment)
        finally:
            holder.communicate()


def _new_network() -> subprocess.Popen[bytes] | None:
    """Return a process in a network namespace of its own, with a loopback; None if not allowed."""
    if not all(shutil.which(tool) for tool in ("unshare", "nsenter", "setpriv")):
        return None
    for options in _OPTIONS:
        holder = subprocess.Popen(
            [
                "unshare",
                "--net",
                *options,
                "--",
                sys.executable,
                "-m",
                "benchmarks.nodes.loopback",
            ],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert holder.stdout is not None
        if holder.stdout.readline():
            return holder
        holder.communicate()
    return None


def _in_network(holder: subprocess.Popen[bytes], environment: dict[str, str]) -> Surroundings:
    del environment["FASTDDS_BUILTIN_TRANSPORTS"]
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    users = [Path(f"/proc/{pid}/ns/user").readlink() for pid in (holder.pid, "self")]
    prefix = (
        *("nsenter", f"--target={holder.pid}", "--net"),
        *(() if users[0] == users[1] else ("--user", "--preserve-credentials")),
        # What a process begins with is gone when it changes its user namespace.
        *("--", "setpriv", "--pdeathsig", "TERM", "--"),
    )
    return Surroundings(environment, prefix, is_closed=False)
