"""Trajectories are decoded beside the loop: a large one must not delay a sample."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache

from hpid_ros.messages import MixedTrajectory, TrajectoryArrays, decode_trajectory

Decoded = TrajectoryArrays | MixedTrajectory | Exception
"""What became of a message; for instance a ``MessageError``."""


class ReferenceDecoder:
    """Decodes the newest message of each source on a thread of its own.

    A message that has not been begun with when the next one of its source comes is dropped, so
    that a flood costs one slot. What several sources have got alike is decoded once.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: dict[object, tuple[bytes, Callable[[Decoded], None]]] = {}
        self._thread: threading.Thread | None = None

    def decode(self, source: object, raw: bytes, take: Callable[[Decoded], None]) -> None:
        """Decode a message soon.

        Args:
            source: Whose newest message this is.
            raw: A serialised JointTrajectory.
            take: Called on the decoder's thread.
        """
        with self._changed:
            self._waiting[source] = raw, take
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="references", daemon=True)
                self._thread.start()
            self._changed.notify()

    def _run(self) -> None:
        last: bytes | None = None
        decoded: Decoded
        while True:
            with self._changed:
                while not self._waiting:
                    self._changed.wait()
                raw, take = self._waiting.pop(next(iter(self._waiting)))
            if raw != last:
                last, decoded = raw, _attempt(raw)
            take(decoded)


def _attempt(raw: bytes) -> Decoded:
    try:
        return decode_trajectory(raw)
    except Exception as error:  # of any kind: whoever takes it raises it where it is heard
        return error


@cache
def reference_decoder() -> ReferenceDecoder:
    """Return the one of this process."""
    return ReferenceDecoder()
