"""How much memory a process has to itself."""

from __future__ import annotations

from pathlib import Path

_PRIVATE = ("Private_Clean:", "Private_Dirty:", "Swap:")
_KIB = 1024


def private_bytes(pid: int) -> int:
    """Return the memory that no other process shares, swapped out or not, in bytes.

    Shared memory of the middleware belongs to all who map it and is no growth of one of them.

    Args:
        pid: The process, of this user.

    Raises:
        ProcessLookupError: There is no such process.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except FileNotFoundError:
        raise ProcessLookupError(f"no process {pid}") from None
    return sum(int(line.split()[1]) for line in lines if line.startswith(_PRIVATE)) * _KIB
