"""The memory that a process has to itself."""

from __future__ import annotations

from pathlib import Path

_OWN = ("Private_Dirty:", "Swap:")
_KIB = 1024


def private_bytes(pid: int) -> int:
    """Return the memory that a process has written and shares with no other, in bytes.

    It counts also when it is swapped out. Shared memory of the middleware belongs to all who map
    it; clean pages are those of files, which come and go with other programs that map them.

    Args:
        pid: The process, of this user.

    Raises:
        ProcessLookupError: There is no such process.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except FileNotFoundError:
        raise ProcessLookupError(f"no process {pid}") from None
    return sum(int(line.split()[1]) for line in lines if line.startswith(_OWN)) * _KIB
