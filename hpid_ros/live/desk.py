"""Who has the robot in hand, of those who look at the page, and how often they may act."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable


class Limit:
    """At most so many acts in so much time."""

    def __init__(
        self, most: int, within: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._most, self._within, self._clock = most, within, clock
        self._acts: deque[float] = deque(maxlen=most)

    def allows(self) -> bool:
        """Tell whether one more act is allowed now, and count it if so."""
        now = self._clock()
        if len(self._acts) == self._most and now - self._acts[0] < self._within:
            return False
        self._acts.append(now)
        return True


class Desk:
    """One page at a time has the controllers in hand; the others look on.

    The first one has it. Another gets it when a person takes it there. A page that was cut off for
    a moment gets it back, if nobody has taken it meanwhile. Stopping is everybody's.
    """

    def __init__(self) -> None:
        self._pages: Counter[str] = Counter()
        self._holder: str | None = None
        self._last: str | None = None

    @property
    def holder(self) -> str | None:
        """The page that has it; None if none is open, or the one that had it is gone."""
        return self._holder

    @property
    def pages(self) -> int:
        """How many pages are open."""
        return len(self._pages)

    def join(self, page: str) -> None:
        """Let a page look on; it has the desk if no other page is there, or if it had it last.

        A page that was cut off may join once more before it has left.
        """
        self._pages[page] += 1
        if len(self._pages) == 1 or (self._holder is None and self._last == page):
            self._holder = self._last = page

    def take(self, page: str) -> None:
        """Give the desk to a page whose person asked for it."""
        if page in self._pages:
            self._holder = self._last = page

    def leave(self, page: str) -> None:
        """Forget a page that has left as often as it has joined.

        What it had in hand nobody has, until somebody takes it.
        """
        self._pages -= Counter([page])
        if self._holder not in self._pages:
            self._holder = None

    def holds(self, page: str) -> bool:
        """Tell whether a page has it."""
        return self._holder == page
