"""A button that must be held while joints move, pressed from any thread."""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
import time
from collections.abc import Iterator

HELD_WITHIN = 0.4
"""Longest time between two presses, in [s]; who holds the button presses several times in it."""

_ENDS_WITHIN = 8.0  # [s] from the release


class Button:
    """Bytes on a process's standard input while somebody holds it, and its end afterwards."""

    def __init__(self, within: float = HELD_WITHIN) -> None:
        self.within = within
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._released_at: float | None = None

    @property
    def is_released(self) -> bool:
        """Whether it has been released; it cannot be pressed again."""
        return self._released_at is not None

    def press(self) -> None:
        """Say that it is held: several times in the time allowed, or joints stop."""
        with self._lock:
            if self._process is None or self._process.stdin is None or self.is_released:
                return
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                os.write(self._process.stdin.fileno(), b".")

    def release(self) -> None:
        """Have the joints stop."""
        with self._lock:
            if self._released_at is None:
                self._released_at = time.monotonic()
            self._close()

    def is_overdue(self) -> bool:
        """Tell whether the process should have ended long ago."""
        released_at = self._released_at
        return released_at is not None and time.monotonic() - released_at > _ENDS_WITHIN

    @contextlib.contextmanager
    def held_for(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        """Tell this process while the block runs."""
        assert process.stdin is not None
        os.set_blocking(process.stdin.fileno(), False)
        with self._lock:
            self._process = process
            if self.is_released:
                self._close()
        try:
            yield
        finally:
            with self._lock:
                self._close()

    def _close(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._process = None
