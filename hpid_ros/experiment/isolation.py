"""Keeps the nodes of an experiment to themselves: the closed mode, and a domain of their own.

With these two settings Fast DDS talks through shared memory alone and opens no network socket,
so that nothing outside this machine and user can hear or command a simulated robot, and the
simulation can never drive a real one on the same network. Each of the settings without the
other is wide open; therefore the processes are looked at once they run.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from hpid_ros.errors import RunError
from hpid_ros.experiment.shared_memory import clear_dead
from hpid_ros.names import PROFILE_FILES
from hpid_ros.resources import find_resource

CLOSED_MODE: Mapping[str, str] = {
    "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    "FASTDDS_BUILTIN_TRANSPORTS": "SHM",
}
"""Environment of the closed mode."""

_OPENING = (
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
    "ROS_DISCOVERY_SERVER",
    "ROS_NAMESPACE",
    # Enclaves are for the open network; the nodes of an experiment have none.
    "ROS_SECURITY_ENABLE",
    "ROS_SECURITY_STRATEGY",
    "ROS_SECURITY_KEYSTORE",
    "ROS_SECURITY_ENCLAVE_OVERRIDE",
)
_DOMAINS = range(1, 102)
_SOCKET_TABLES = ("tcp", "tcp6", "udp", "udp6", "raw", "raw6")


def closed_environment(domain: int) -> dict[str, str]:
    """Return the environment for a closed process.

    Args:
        domain: Its ROS domain.
    """
    environment = {name: value for name, value in os.environ.items() if name not in _OPENING}
    environment.update(CLOSED_MODE)
    environment["ROS_DOMAIN_ID"] = str(domain)
    profile = str(find_resource("config/fastdds.xml"))
    environment |= dict.fromkeys(PROFILE_FILES, profile)
    environment["PYTHONUNBUFFERED"] = "1"
    return environment


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a ROS domain that no other experiment on this machine has, free of dead ports.

    Yields:
        The domain.

    Raises:
        RunError: All domains are taken.
    """
    folder = Path(tempfile.gettempdir()) / f"hpid_ros_domains_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    clear_dead()
    for domain in _DOMAINS:
        lock = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        try:
            yield domain
        finally:
            os.close(lock)
        return
    raise RunError(f"all ROS domains from {_DOMAINS[0]} to {_DOMAINS[-1]} are taken")


def require_no_sockets(pids: Iterable[int]) -> None:
    """Make sure that no process has a network socket.

    Args:
        pids: The processes.

    Raises:
        RunError: One of them has.
    """
    for pid in pids:
        try:
            addresses = network_sockets(pid)
        except (FileNotFoundError, ProcessLookupError):  # it has just ended
            continue
        if addresses:
            raise RunError(
                f"the closed mode is not closed: process {pid} has network sockets "
                f"({', '.join(sorted(addresses))}); the run is ended"
            )


def network_sockets(pid: int) -> set[str]:
    """Return the kinds of network socket that a process holds, for instance ``udp``.

    Args:
        pid: The process, of this user.
    """
    inodes = _socket_inodes(Path(f"/proc/{pid}/fd"))
    kinds = set()
    for kind in _SOCKET_TABLES:
        table = Path(f"/proc/{pid}/net/{kind}")
        if not table.exists():
            continue
        for line in table.read_text().splitlines()[1:]:
            if line.split()[9] in inodes:
                kinds.add(kind)
    return kinds


def _socket_inodes(folder: Path) -> set[str]:
    inodes = set()
    for entry in folder.iterdir():
        try:
            target = str(entry.readlink())
        except FileNotFoundError:  # closed since the folder was listed
            continue
        if target.startswith("socket:["):
            inodes.add(target[len("socket:[") : -1])
    return inodes
