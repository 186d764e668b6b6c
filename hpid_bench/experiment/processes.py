"""Processes of nodes in an isolated domain: started, watched and ended together.

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
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

from hpid_bench.experiment.forking import Beginning, ForkedProcess, ForkServer
from hpid_ros.base.errors import RunError
from hpid_ros.base.names import PROFILE_FILES
from hpid_ros.base.processes import uninterrupted
from hpid_ros.base.resources import find_resource
from hpid_ros.base.yaml_text import inline_yaml

SHARED_MEMORY = Path("/dev/shm")
SHARED_MEMORY_ROOM = 64 * 2**20  # [bytes] of shared memory for a run of eleven processes
_LEAST_ROOM = 16 * 2**20  # [bytes]; with 12 MB not all nodes of the shortest run could be made
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


def shared_memory_left(folder: Path = SHARED_MEMORY) -> int:
    """Return how many bytes of shared memory are left; none where there is no place for any."""
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return 0
    return shutil.disk_usage(folder).free


def require_shared_memory(least: int = _LEAST_ROOM) -> None:
    """Refuse a run whose nodes could not send anything to each other."""
    left = shared_memory_left()
    if left < least:
        raise RunError(f"{SHARED_MEMORY} is full: {_left(left)}")


@contextmanager
def blaming_shared_memory() -> Iterator[None]:
    """Say of a run that fails that shared memory is short, where it is.

    Fast DDS says nothing of it: nodes cannot be made, end by SIGBUS, or do not hear each other.
    """
    try:
        yield
    except RunError as error:
        left = shared_memory_left()
        if left >= SHARED_MEMORY_ROOM:
            raise
        raise RunError(f"{error}; {SHARED_MEMORY} may have been full: {_left(left)}") from None


def _left(left: int) -> str:
    return (
        f"{left / 2**20:.0f} MB are free, and nodes send each other everything there; remove what "
        f"fills it, or give it {SHARED_MEMORY_ROOM // 2**20} MB or more "
        "(docker run --shm-size=512m)"
    )


def warm_up() -> None:
    """Begin to import what the nodes of a run need, while this process imports what it does."""
    ForkServer.of({**os.environ, **CLOSED_MODE})


def closed_environment(domain: int) -> dict[str, str]:
    return {
        **{name: value for name, value in os.environ.items() if name not in _OPENING},
        **CLOSED_MODE,
        "ROS_DOMAIN_ID": str(domain),
        **dict.fromkeys(PROFILE_FILES, str(find_resource("config/fastdds.xml"))),
        "PYTHONUNBUFFERED": "1",
    }


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a ROS domain that nobody else on this machine uses, free of dead ports.

    It is the one whose last use is the longest ago: what a process that was killed there left
    behind has then been cleared.
    """
    folder = Path(tempfile.gettempdir()) / f"hpid_ros_domains_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    clear_dead()

    def last_use(domain: int) -> float:
        lock = folder / str(domain)
        return lock.stat().st_mtime if lock.exists() else 0.0

    for domain in sorted(set(_DOMAINS) - _domains_in_use(), key=last_use):
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


def require_no_sockets(pids: Iterable[int]) -> None:
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
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed since the folder was listed
            target = str(entry.readlink())
            if target.startswith("socket:["):
                inodes.add(target[len("socket:[") : -1])
    kinds = set()
    for kind in _SOCKET_TABLES:
        table = Path(f"/proc/{pid}/net/{kind}")
        if not table.exists():
            continue
        for line in table.read_text().splitlines()[1:]:
            if line.split()[9] in inodes:
                kinds.add(kind)
    return kinds


Process = subprocess.Popen[bytes] | ForkedProcess


def end_all(processes: Iterable[Process], patience: float) -> None:
    """Ask all to end with SIGTERM, then kill those that have not gone."""
    running = [process for process in processes if process.poll() is None]
    for process in running:
        process.terminate()
    deadline = time.monotonic() + patience
    for process in running:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def module_of(executable: str) -> str:
    """Return the module of an executable: below ``nodes``, or where a dotted name says."""
    return f"hpid_bench.{executable}" if "." in executable else f"hpid_ros.nodes.{executable}"


def parameters(**values: object) -> list[str]:
    """Return the ROS arguments that set parameters."""
    arguments = []
    for name, value in values.items():
        # ROS reads it as YAML, to which a path may be a comment or a mapping.
        text = inline_yaml(str(value) if isinstance(value, Path) else value)
        arguments += ["-p", f"{name}:={text}"]
    return arguments


class NodeProcess:
    """One node in a process of its own, with a pipe for its events."""

    def __init__(self, name: str, process: Process, events: int, log: Path) -> None:
        self.name, self.process, self.events, self.log = name, process, events, log
        self.is_open = True  # whether events may still come
        self._buffer = b""

    @property
    def pid(self) -> int:
        return self.process.pid

    def read_events(self) -> list[dict[str, Any]]:
        """Return the events that have come since the last call."""
        try:
            while chunk := os.read(self.events, 65536):
                self._buffer += chunk
            self.is_open = False
        except BlockingIOError:
            pass
        *lines, self._buffer = self._buffer.split(b"\n")
        return [json.loads(line) for line in lines]

    def last_words(self) -> str:
        """Return the last line that the node printed, for an error message."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"


class NodeGroup(AbstractContextManager["NodeGroup"]):
    """Starts nodes and ends all of them, whatever happens."""

    popen: ClassVar[type[subprocess.Popen[bytes]]] = subprocess.Popen

    def __init__(
        self,
        environment: Mapping[str, str],
        logs: Path,
        *,
        is_batch: bool = False,
        is_forked: bool = False,
        prefix: Sequence[str] = (),
    ) -> None:
        self._environment, self._logs, self._is_forked = dict(environment), logs, is_forked
        self._beginning, self._prefix = Beginning(signal.SIGTERM, is_batch), prefix
        self.nodes: dict[str, NodeProcess] = {}

    def start(
        self,
        name: str,
        executable: str,
        arguments: Sequence[str],
        *,
        is_renamed: bool = True,
        has_input: bool = False,
    ) -> NodeProcess:
        """Start a node in a session of its own."""
        log = self._logs / f"{name}.log"
        with uninterrupted(), log.open("wb") as output:
            reader, writer = os.pipe()
            os.set_blocking(reader, False)
            module = module_of(executable)
            given = [
                "--ros-args",
                *(("-r", f"__node:={name}") if is_renamed else ()),
                "-p",
                f"status_fd:={writer}",
                *arguments,
            ]
            if self._is_forked:
                process = self._forked(module, given, output.fileno(), writer)
            else:
                process = self.popen(
                    [*self._prefix, sys.executable, "-m", module, *given],
                    stdin=subprocess.PIPE if has_input else subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=self._environment,
                    pass_fds=[writer],
                    start_new_session=True,
                    preexec_fn=self._beginning,
                )
            os.close(writer)
            self.nodes[name] = node = NodeProcess(name, process, reader, log)
        return node

    def _forked(self, module: str, given: Sequence[str], output: int, writer: int) -> Process:
        with Path(os.devnull).open("rb") as nothing:
            files = {0: nothing.fileno(), 1: output, 2: output, writer: writer}
            server = ForkServer.of(self._environment)
            return ForkedProcess(
                server.fork(module, given, self._environment, self._beginning, files)
            )

    def stop(self, names: Sequence[str] | None = None, patience: float = 1.5) -> None:
        """End nodes: ask all of them, then kill those that have not gone."""
        chosen = self.nodes if names is None else names
        end_all((self.nodes[name].process for name in chosen), patience)

    def __exit__(self, *error: object) -> None:
        self.stop()
        for node in self.nodes.values():
            os.close(node.events)
