"""PyBullet: imported once and kept quiet, a simulation of its own for each world.

Bullet prints from C, past Python's ``sys.stdout``. A line of it in the middle of a program's
machine-readable output would corrupt that output, so whatever talks to Bullet where it prints
does so inside :func:`captured`.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["captured", "connected", "disconnect", "pybullet"]

_logger = logging.getLogger(__name__)
_STANDARD_STREAMS = (1, 2)


@contextmanager
def captured() -> Iterator[list[str]]:
    """Divert what C code prints to stdout and stderr into a list of lines, and to the log.

    The process's file descriptors are diverted, so the block is meant to be short: loading a
    model, not stepping it.
    """
    lines: list[str] = []
    with tempfile.TemporaryFile() as sink:
        _flush()
        saved = [os.dup(stream) for stream in _STANDARD_STREAMS]
        try:
            for stream in _STANDARD_STREAMS:
                os.dup2(sink.fileno(), stream)
            yield lines
        finally:
            _flush()
            for stream, copy in zip(_STANDARD_STREAMS, saved, strict=True):
                os.dup2(copy, stream)
                os.close(copy)
            sink.seek(0)
            text = sink.read().decode("utf-8", "replace")
            lines.extend(line for line in text.splitlines() if line.strip())
    for line in lines:
        _logger.debug("bullet: %s", line)


def _flush() -> None:
    """Empty the buffers of Python's and of C's streams."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    ctypes.CDLL(None).fflush(None)


with captured():
    import pybullet  # prints its build time


def connected(gui: bool) -> int:
    """Return the client of a new, empty simulation."""
    with captured():
        client: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
    return client


def disconnect(client: int) -> None:
    """Free the simulation of a client; one below 0 is none."""
    if client >= 0:
        with captured():
            pybullet.disconnect(physicsClientId=client)
