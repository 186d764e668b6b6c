"""A button that somebody must hold: bytes that come on standard input while it is held."""

from __future__ import annotations

import os
import select
import sys
import time

_AT_ONCE = 65536


class DeadMan:
    """Whether the button is held. The end of input says that the writer is gone."""

    def __init__(self, within: float) -> None:
        self._within = within
        self.is_gone = False
        self._input = sys.stdin.fileno()
        self._last = -float("inf")

    def is_held(self) -> bool:
        """Tell whether it is held; to be asked more often than a byte must come."""
        now = time.monotonic()
        if self._has_come():
            self._last = now
        return not self.is_gone and now - self._last < self._within

    def forget(self) -> None:
        """Take it for not held until a byte comes."""
        self._has_come()
        self._last = -float("inf")

    def _has_come(self) -> bool:
        has_come = False
        while not self.is_gone and select.select([self._input], [], [], 0.0)[0]:
            try:
                count = len(os.read(self._input, _AT_ONCE))
            except OSError:  # nobody gave it any input
                count = 0
            has_come |= count > 0
            self.is_gone = count == 0
        return has_come
