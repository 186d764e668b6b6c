"""Interrupts that are never lost.

Python raises ``KeyboardInterrupt`` wherever it happens to be, and swallows it in places that
cannot raise, for instance between a fork and what follows it. What takes long therefore asks
here as well.
"""

from __future__ import annotations

import signal
from types import FrameType

_is_requested = False


def heed_interrupts() -> None:
    """Treat SIGINT and SIGTERM as an interrupt, also where the shell had them ignored."""
    global _is_requested
    _is_requested = False
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def raise_if_interrupted() -> None:
    """Raise what was asked for and perhaps swallowed.

    Raises:
        KeyboardInterrupt: There was an interrupt since :func:`heed_interrupts`.
    """
    if _is_requested:
        raise KeyboardInterrupt


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _is_requested
    is_first, _is_requested = not _is_requested, True
    if is_first:  # a second one must not disturb the cleaning up after the first
        raise KeyboardInterrupt
