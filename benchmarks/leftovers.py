"""Leftovers of a run: processes, threads, and files of shared memory that nobody uses."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hpid_ros.experiment.processes import SHARED_MEMORY, YOUNG, clear_dead

_PAUSE = 1.0  # [s]


@contextmanager
def watched_leftovers() -> Iterator[list[str]]:
    """Compare before and after.

    Yields:
        A list that afterwards has a line for everything that was left behind.
    """
    clear_dead()
    before = _present()
    found: list[str] = []
    yield found
    # What killed processes cannot take away themselves is cleared once it is old enough not to be
    # of a process that is just starting.
    deadline = time.monotonic() + YOUNG + 5.0
    while (left := _present() - before) and time.monotonic() < deadline:
        clear_dead()
        time.sleep(_PAUSE)
    found += [f"left behind: {each}" for each in sorted(left)]


def _present() -> set[str]:
    """Return this process's children and threads, and the middleware's files that nobody uses."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    files = {file.name for file in SHARED_MEMORY.glob("*fastrtps*")} - _used_files()
    return {
        *(f"thread {thread.name}" for thread in threading.enumerate()),
        *(f"process {pid}" for pid in children),
        *(f"file {name}" for name in files),
    }


def _used_files() -> set[str]:
    """Return the names of files of shared memory that some process has open or mapped."""
    used = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            paths = [str(entry.readlink()) for entry in (process / "fd").iterdir()]
            paths += [line.split()[-1] for line in (process / "maps").read_text().splitlines()]
        except (FileNotFoundError, PermissionError, ProcessLookupError):
            continue
        used |= {Path(path).name for path in paths if path.startswith(str(SHARED_MEMORY))}
    return used
