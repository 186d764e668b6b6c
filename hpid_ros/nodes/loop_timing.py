"""How regularly a controller is called, and how long it takes."""

from __future__ import annotations

from typing import Any

from hpid_ros.durations import Durations


class LoopTiming:
    """Wall-clock figures of one controller.

    The period is the time between two states' callbacks; jitter is how far its 99th percentile
    lies above its median. The compute time runs from the bytes of a state in hand to the command
    handed to the middleware.
    """

    def __init__(self) -> None:
        self._periods, self._computes = Durations(), Durations()
        self._note_period, self._note_compute = self._periods.note, self._computes.note
        self.last_ns: int | None = None
        """When the last sample began on a steady clock, in [ns]."""

    def note(self, began_ns: int, ended_ns: int) -> None:
        """Note one sample.

        Args:
            began_ns: When its callback began on a steady clock, in [ns].
            ended_ns: When its command was sent, in [ns].
        """
        if self.last_ns is not None:
            self._note_period(began_ns - self.last_ns)
        self.last_ns = began_ns
        self._note_compute(ended_ns - began_ns)

    def interrupt(self) -> None:
        """Take the next sample as the first one: the time until then is no period."""
        self.last_ns = None

    def recent(self) -> dict[str, float]:
        """Return the figures since the last call, with their units, for ``/diagnostics``."""
        period, compute = self._periods.recent(), self._computes.recent()
        return {
            "period, median [us]": period.median,
            "period, 99th percentile [us]": period.p99,
            "period, largest [us]": period.maximum,
            "jitter [us]": period.p99 - period.median,
            "compute time, median [us]": compute.median,
            "compute time, 99th percentile [us]": compute.p99,
            "compute time, largest [us]": compute.maximum,
        }

    def whole(self) -> dict[str, Any]:
        """Return the figures of the whole run, in [us], for a parent process."""
        return {
            "period": self._periods.whole()._asdict(),
            "compute": self._computes.whole()._asdict(),
        }
