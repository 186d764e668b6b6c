"""Brings the loopback of a new network namespace up and keeps the namespace until stdin ends."""

from __future__ import annotations

import fcntl
import socket
import struct
import sys

_SIOCSIFFLAGS = 0x8914
_UP = 0x1


def main() -> None:
    """Bring it up, say so, and wait."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", _UP))
    print("up", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
