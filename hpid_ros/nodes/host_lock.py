"""One process a joint on one host: a name that the kernel gives to one process alone.

The name is that of an abstract unix socket. To take it is atomic, the kernel frees it when the
process ends, however that ends, and it costs nothing in between. A second socket of the holder
bears who it is in its name: that can be read in the table of the kernel even while the holder is
frozen, and nobody can send anything to either.
"""

from __future__ import annotations

import errno
import hashlib
import os
import socket
import time
from pathlib import Path

_PREFIX = "hpid_ros/"
_LONGEST_NAME = 107  # bytes of an abstract name, by the kernel
_TABLE = Path("/proc/net/unix")
_TRIES, _PAUSE = 10, 0.002  # [s]; between the two sockets of a holder lies less than that


class HostLock:
    """The right to something on this host, or rather in this network namespace.

    Args:
        key: What it is a right to.
        owner: Full name of the node that would hold it.
    """

    def __init__(self, key: str, owner: str) -> None:
        self._name = _PREFIX + hashlib.sha256(key.encode()).hexdigest()[:16]
        self._owner = owner
        self._sockets: list[socket.socket] = []

    @staticmethod
    def realm() -> str:
        """Return a name of where locks hold: kernel and network namespace; empty if nowhere."""
        try:
            _bound(f"{_PREFIX}{os.getpid()}/{time.monotonic_ns()}").close()
            boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
            return f"{boot} {Path('/proc/self/ns/net').readlink()}"
        except OSError:  # not Linux, or a sandbox
            return ""

    def take(self) -> str:
        """Take the right.

        Returns:
            Empty if it is held now; else who holds it, in words.
        """
        if self._sockets:
            return ""
        try:
            self._sockets.append(_bound(self._name))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return self._holder()
        plate = f"{self._name}/{os.getpid()}"
        room = _LONGEST_NAME - len(plate) - 2
        self._sockets.append(_bound(f"{plate}/{self._owner[-room:]}"))
        return ""

    def release(self) -> None:
        """Give the right back; the name plate goes first."""
        while self._sockets:
            self._sockets.pop().close()

    def _holder(self) -> str:
        start = f"@{self._name}/"
        for _ in range(_TRIES):
            try:
                table = _TABLE.read_text(encoding="utf-8", errors="replace")
            except OSError:
                break
            for line in table.splitlines():
                name = line.rpartition(" ")[2]
                if name.startswith(start):
                    pid, _, node = name[len(start) :].partition("/")
                    return f"{node} (process {pid} of this host)"
            time.sleep(_PAUSE)
        return "a process of this host that cannot be named"


def _bound(name: str) -> socket.socket:
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        holder.bind("\0" + name)
    except BaseException:
        holder.close()
        raise
    return holder
