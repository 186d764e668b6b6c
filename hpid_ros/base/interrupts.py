"""Interrupts that are never lost.

Python raises ``KeyboardInterrupt`` wherever it happens to be, and swallows it in places that
cannot raise, for instance between a fork and what follows it. What takes long therefore asks
here as well.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_is_requested = False
_postponed = 0


def heed_interrupts() -> None:
    """Treat SIGINT and SIGTERM as an interrupt, also where the shell had them ignored."""
    global _is_requested
    _is_requested = False
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def raise_if_interrupted() -> None:
    """Raise what was asked for and perhaps swallowed."""
    if _is_requested:
        raise KeyboardInterrupt


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Postpone an interrupt to the end of a block, as where a new process is written down."""
    global _postponed
    was_requested = _is_requested
    _postponed += 1
    try:
        yield
    finally:
        _postponed -= 1
    if _is_requested and not was_requested and not _postponed:
        raise KeyboardInterrupt


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _is_requested
    is_first, _is_requested = not _is_requested, True
    if (
        is_first and not _postponed
    ):  # a second one must not disturb the cleaning up after the first
        raise KeyboardInterrupt
