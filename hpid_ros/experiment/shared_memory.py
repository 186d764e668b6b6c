"""Clears away what killed processes left of Fast DDS in shared memory.

A process that is killed leaves its segment and its ports behind, half a megabyte and more, and a
port may keep a lock that nobody will ever release: later processes of the same domain then do not
find each other. Whoever lives holds a file lock beside each of its segments and ports; what is
locked by nobody is dead. The tool ``fastdds shm clean``, which the ROS wheels lack, goes by the
same rule.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
YOUNG = 30.0  # [s]; a process that is just starting may not hold its locks yet

_LOCKS = ("_el", "_sl")  # of one listener, or of several
_FILE = re.compile(r"(?:sem\.)?(fastrtps_(?:port\d+|[0-9a-f]{16}))(?:_el|_sl|_mutex)?")


def clear_dead(folder: Path = SHARED_MEMORY, least_age: float = YOUNG) -> int:
    """Remove the segments and ports that no living process holds, and what is left of them.

    Args:
        folder: Where they lie.
        least_age: What was made or used later than this is left alone, in [s].

    Returns:
        How many there were.
    """
    if not folder.is_dir():
        return 0
    names = {entry.name for entry in folder.iterdir()}
    things = {match[1] for name in names if (match := _FILE.fullmatch(name))}
    return sum(_remove_if_dead(folder, name, names, least_age) for name in sorted(things))


def _remove_if_dead(folder: Path, name: str, names: set[str], least_age: float) -> bool:
    files = [name, *(name + lock for lock in _LOCKS), f"sem.{name}_mutex"]
    paths = [folder / file for file in files if file in names]
    try:
        if any(_is_young(path, least_age) for path in paths):
            return False
        if any(_is_held(folder / (name + lock)) for lock in _LOCKS if name + lock in names):
            return False
        for path in paths:
            path.unlink(missing_ok=True)
    except (PermissionError, FileNotFoundError):  # another user's, or somebody else was faster
        return False
    return True


def _is_young(path: Path, least_age: float) -> bool:
    status = path.stat()
    return time.time() - max(status.st_mtime, status.st_ctime) < least_age


def _is_held(path: Path) -> bool:
    descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
