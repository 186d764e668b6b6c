"""A graph that nothing outside reaches, and its shared memory.

A process that is killed leaves its segment and its ports behind, half a megabyte and more, and a
port may keep a lock that nobody will ever release: later processes of the same domain then do not
find each other. Whoever lives holds a file lock beside each of its segments and ports; what is
locked by nobody is dead. The tool ``fastdds shm clean``, which the ROS wheels lack, goes by the
same rule.

With these two settings Fast DDS talks through shared memory alone and opens no network socket,
so that nothing outside this machine and user can hear or command a simulated robot, and the
simulation can never drive a real one on the same network. Each of the settings without the
other is wide open; therefore the processes are looked at once they run.
"""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hpid_ros.base.errors import RunError
from hpid_ros.base.names import PROFILE_FILES
from hpid_ros.base.resources import find_resource

SHARED_MEMORY = Path("/dev/shm")
YOUNG = 30.0  # [s]; a process that is just starting may not hold its locks yet

_LOCKS = ("_el", "_sl")  # of one listener, or of several
_FILE = re.compile(r"(?:sem\.)?(fastrtps_(?:port\d+|[0-9a-f]{16}))(?:_el|_sl|_mutex)?")


def clear_dead(folder: Path = SHARED_MEMORY, least_age: float = YOUNG) -> int:
    """Remove the segments and ports that no living process holds, and what is left of them."""
    if not folder.is_dir():
        return 0
    names = {entry.name for entry in folder.iterdir()}
    things = {match[1] for name in names if (match := _FILE.fullmatch(name))}
    return sum(_remove_if_dead(folder, name, least_age) for name in sorted(things))


def _remove_if_dead(folder: Path, name: str, least_age: float) -> bool:
    """Remove what nobody holds, while nobody can begin to.

    Who listens locks one of the two files, which need not exist yet: where nobody holds the one
    that does, the other is made and held, too, until all is gone. Who starts at that moment finds
    the port taken, and takes the next one.
    """
    locks = [folder / (name + lock) for lock in _LOCKS]
    others = [folder / name, folder / f"sem.{name}_mutex"]
    try:
        there = [path for path in (*others, *locks) if path.exists()]
        if not there or any(_is_young_or_foreign(path, least_age) for path in there):
            return False
        with ExitStack() as held:
            taken: list[Path] = []
            for path in sorted(locks, key=there.__contains__, reverse=True):
                if not _is_taken(path, held):  # and what this has made must not stay
                    gone = [each for each in taken if each not in there]
                    break
                taken.append(path)
            else:
                gone = [*others, *locks]
            for path in gone:
                path.unlink(missing_ok=True)
    except (PermissionError, FileNotFoundError):  # another user's, or somebody else was faster
        return False
    return len(taken) == len(locks)


def _is_young_or_foreign(path: Path, least_age: float) -> bool:
    status = path.stat()
    age = time.time() - max(status.st_mtime, status.st_ctime)
    return age < least_age or status.st_uid != os.getuid()


def _is_taken(path: Path, held: ExitStack) -> bool:
    """Take a lock until the end of a block, and tell whether it could be had."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    held.callback(os.close, descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


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
_FIRST_PORT, _PORTS_OF_A_DOMAIN = 7400, 250  # of the DDSI-RTPS specification
_SOCKET_TABLES = ("tcp", "tcp6", "udp", "udp6", "raw", "raw6")


def closed_environment(domain: int) -> dict[str, str]:
    """Return the environment for a closed process."""
    environment = {name: value for name, value in os.environ.items() if name not in _OPENING}
    environment.update(CLOSED_MODE)
    environment["ROS_DOMAIN_ID"] = str(domain)
    profile = str(find_resource("config/fastdds.xml"))
    environment |= dict.fromkeys(PROFILE_FILES, profile)
    environment["PYTHONUNBUFFERED"] = "1"
    return environment


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a ROS domain that nobody else on this machine uses, free of dead ports.

    It is the one whose last use is the longest ago: what a process that was killed there left
    behind has then been cleared.
    """
    folder = Path(tempfile.gettempdir()) / f"hpid_ros_domains_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    clear_dead()
    free = set(_DOMAINS) - _domains_in_use()
    for domain in sorted(free, key=lambda each: _last_use(folder / str(each))):
        lock = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        os.utime(lock)
        try:
            yield domain
        finally:
            os.close(lock)
        return
    raise RunError(f"all ROS domains from {_DOMAINS[0]} to {_DOMAINS[-1]} are taken")


def _domains_in_use() -> set[int]:
    """Return the domains in which somebody listens by UDP, or has listened in shared memory."""
    ports = {
        int(line.split()[1].rpartition(":")[2], 16)
        for table in (Path("/proc/net/udp"), Path("/proc/net/udp6"))
        if table.exists()
        for line in table.read_text().splitlines()[1:]
    }
    locks = SHARED_MEMORY.glob("fastrtps_port*_[es]l")
    ports |= {int(re.sub(r"\D", "", lock.name)) for lock in locks}
    return {(port - _FIRST_PORT) // _PORTS_OF_A_DOMAIN for port in ports}


def _last_use(lock: Path) -> float:
    return lock.stat().st_mtime if lock.exists() else 0.0


def require_no_sockets(pids: Iterable[int]) -> None:
    """Make sure that no process has a network socket."""
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
    """Return the kinds of network socket that a process holds, for instance ``udp``."""
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
