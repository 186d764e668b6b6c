"""Nodes that are forked from an interpreter that has imported them already.

A node spends most of the processor time of its start on imports. A server imports once, before any
thread and any middleware is there, and forks a process for each node. It is the same process in
every other respect: a child of its starter, in a session of its own, with the environment,
arguments, files and exit code of ``python -m MODULE``. It ends with the process that started it.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import importlib
import inspect
import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, ClassVar

from hpid_ros.base.errors import RunError

_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
_LIBC = ctypes.CDLL(None)
_ENDING = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)
_LARGEST = 1 << 18  # [byte], of a request
_OF_A_RUN = (
    "trajectory_publisher",
    "bag_recorder",
    "joint_controller",
    "pybullet_bridge",
    "mujoco_bridge",
)
_LOOKS_AT_PIPES = "hpid_ros.nodes.core.status"  # when it is imported: which ones it was given


class Beginning:
    """What a child runs before its program, for ``preexec_fn``."""

    def __init__(
        self, parting: signal.Signals, is_batch: bool = False, parent: int | None = None
    ) -> None:
        self.parent = os.getpid() if parent is None else parent
        self.parting = parting  # what the kernel sends it when its parent is gone, however
        self.is_batch = is_batch  # waking another process does not make it yield the processor

    def __call__(self) -> None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, self.parting)
        if os.getppid() != self.parent:  # it was gone before
            os.kill(os.getpid(), self.parting)
        if self.is_batch:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


class ForkedProcess:
    """A forked child, with the methods of :class:`subprocess.Popen` that nodes are used by."""

    stdin = None

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._watched = os.pidfd_open(pid)

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            if not select.select([self._watched], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            os.close(self._watched)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """Forks nodes for this process, and ends with it."""

    _servers: ClassVar[dict[str, ForkServer]] = {}

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> ForkServer:
        """Return the one for the middleware of an environment, which is loaded by an import."""
        middleware = environment.get("RMW_IMPLEMENTATION", "")
        if middleware not in cls._servers:
            cls._servers[middleware] = cls(environment)
        return cls._servers[middleware]

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self._channel, theirs):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST)
        path = os.pathsep.join(each for each in sys.path if each)
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            start_new_session=True,  # Ctrl-C is for us
            # Threads do not survive a fork.
            env={**environment, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"},
        )
        theirs.close()
        atexit.register(self._end)

    def _end(self) -> None:
        self._channel.close()
        self._process.kill()  # it may still be importing, and nobody waits for that
        self._process.wait()

    def fork(
        self,
        module: str,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        beginning: Beginning,
        files: Mapping[int, int],
        folder: str | None = None,
    ) -> int:
        """Start a node with these files, by their numbers in it, and return its process id.

        The kernel makes a child of this process of one whose parent has ended, as long as this
        is the reaper of what it descends from: so it can be waited for like any other child.
        """
        request = {
            "module": module,
            "arguments": list(arguments),
            "environment": dict(environment),
            "ignored": [int(each) for each in _ENDING if signal.getsignal(each) == signal.SIG_IGN],
            "core": resource.getrlimit(resource.RLIMIT_CORE),
            "folder": folder,
            "beginning": [int(beginning.parting), beginning.is_batch, beginning.parent],
            "numbers": list(files),
        }
        _LIBC.prctl(_PR_SET_CHILD_SUBREAPER, 1)
        try:
            content = [json.dumps(request).encode()]
            socket.send_fds(self._channel, content, list(files.values()))
            answer = self._channel.recv(64)
        except OSError:
            answer = b""
        finally:
            _LIBC.prctl(_PR_SET_CHILD_SUBREAPER, 0)
        if not answer:
            raise RunError(f"{module} cannot be started: what forks nodes has ended")
        return int(answer)


def _serve(channel: socket.socket) -> tuple[dict[str, Any], list[int]] | None:
    """Fork a process for each request; return in the process what it asks for, at the end None."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it goes when its starter goes
    while True:
        data, files, _, _ = socket.recv_fds(channel, _LARGEST, 16)
        if not data:
            return None
        request = json.loads(data)
        with suppress(Exception):  # the node says what is wrong, as its last words
            importlib.import_module(request["module"])
        gc.freeze()
        between = os.fork()
        if between:
            os.waitpid(between, 0)
            for file in files:
                os.close(file)
            continue
        between = os.getpid()
        if os.fork():
            os._exit(0)
        while os.getppid() == between:
            time.sleep(1e-4)
        channel.send(str(os.getpid()).encode())
        channel.close()
        return request, files


def _become(request: Mapping[str, Any], files: Sequence[int]) -> None:
    """Make this process what a new interpreter would have been."""
    os.setsid()
    # What ps and pgrep call it; the command line stays the server's.
    _LIBC.prctl(_PR_SET_NAME, request["module"].rpartition(".")[2].encode())
    for number in _ENDING:  # as exec leaves them: ignored ones stay so
        is_ignored = int(number) in request["ignored"]
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if is_ignored else usual)
    parting, *more = request["beginning"]
    Beginning(signal.Signals(parting), *more)()
    resource.setrlimit(resource.RLIMIT_CORE, tuple(request["core"]))
    spare = [os.dup(file) for file in files]
    above = max([*spare, *request["numbers"]]) + 1
    spare = [os.dup2(file, above + index) for index, file in enumerate(spare)]
    os.closerange(3, above)
    for file, number in zip(spare, request["numbers"], strict=True):
        os.dup2(file, number, inheritable=True)
        os.close(file)
    if request["folder"]:
        os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.argv = [request["module"], *request["arguments"]]


def main() -> int:
    for name in _OF_A_RUN:
        with suppress(Exception):
            importlib.import_module(f"hpid_ros.nodes.{name}")
    inspect.stack()  # each node does (executor.py): what it remembers is found once
    wanted = _serve(socket.socket(fileno=int(sys.argv[1])))
    if wanted is None:
        return 0
    _become(*wanted)
    importlib.reload(importlib.import_module(_LOOKS_AT_PIPES))
    code: int = importlib.import_module(wanted[0]["module"]).main()
    return code


if __name__ == "__main__":
    sys.exit(main())
