"""Processes of nodes, started, heard and ended together."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

from hpid_ros.base.interrupts import uninterrupted

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


@dataclass(frozen=True)
class Beginning:
    """What a child runs before its program, for ``preexec_fn``."""

    # what the kernel sends the child when its parent is gone, however that came about
    parting: signal.Signals
    # schedule it as a batch job: it yields the processor to nobody by waking somebody
    is_batch: bool = False

    def __call__(self) -> None:
        """Run it, in the child."""
        _LIBC.prctl(_PR_SET_PDEATHSIG, self.parting)
        if self.is_batch:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def end_all(processes: Iterable[subprocess.Popen[bytes]], patience: float) -> None:
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


class NodeProcess:
    """One node in a process of its own, in a session of its own, with a pipe for its events."""

    popen: ClassVar[type[subprocess.Popen[bytes]]] = subprocess.Popen

    def __init__(
        self,
        name: str,
        executable: str,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        log: Path,
        is_renamed: bool = True,
        is_batch: bool = False,
        prefix: Sequence[str] = (),
        has_input: bool = False,
    ) -> None:
        self.name = name
        self.log = log
        self._buffer = b""
        reader, writer = os.pipe()
        os.set_blocking(reader, False)
        self.events = reader
        command = [
            *prefix,
            *(sys.executable, "-m", f"hpid_ros.nodes.{executable}", "--ros-args"),
            *(("-r", f"__node:={name}") if is_renamed else ()),
            *("-p", f"status_fd:={writer}"),
            *arguments,
        ]
        with log.open("wb") as output:
            self.process = self.popen(
                command,
                stdin=subprocess.PIPE if has_input else subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=dict(environment),
                pass_fds=[writer],
                start_new_session=True,
                preexec_fn=Beginning(signal.SIGTERM, is_batch),
            )
        os.close(writer)

    @property
    def pid(self) -> int:
        """Process id."""
        return self.process.pid

    def read_events(self) -> list[dict[str, Any]]:
        """Return the events that have come since the last call."""
        try:
            while chunk := os.read(self.events, 65536):
                self._buffer += chunk
        except BlockingIOError:
            pass
        *lines, self._buffer = self._buffer.split(b"\n")
        return [json.loads(line) for line in lines]

    def last_words(self) -> str:
        """Return the last line that the node printed, for an error message."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"


class NodeGroup:
    """Starts nodes and ends all of them, whatever happens."""

    def __init__(
        self,
        environment: Mapping[str, str],
        logs: Path,
        *,
        is_batch: bool = False,
        prefix: Sequence[str] = (),
    ) -> None:
        self._is_batch, self._prefix = is_batch, prefix
        self._environment = environment
        self._logs = logs
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
        """Start a node."""
        log = self._logs / f"{name}.log"
        with uninterrupted():
            node = NodeProcess(
                name,
                executable,
                arguments,
                self._environment,
                log,
                is_renamed=is_renamed,
                is_batch=self._is_batch,
                prefix=self._prefix,
                has_input=has_input,
            )
            self.nodes[name] = node
        return node

    def stop(self, names: Sequence[str] | None = None, patience: float = 1.5) -> None:
        """End nodes: ask all of them, then kill those that have not gone."""
        chosen = self.nodes if names is None else names
        end_all((self.nodes[name].process for name in chosen), patience)

    def __enter__(self) -> NodeGroup:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()
        for node in self.nodes.values():
            os.close(node.events)
