"""One joint's numbers as they were recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.bags.batches import Integers, Numbers
from hpid_ros.bags.families import Claims


class JointSamples(NamedTuple):
    """One joint's numbers in the order of the log.

    Attributes:
        stamps_ns: Header stamps, (n,), in [ns]; None if the messages carry none.
        log_times_ns: Receive times, (n,), in [ns]; None if they were not kept.
        places: Ascending with the order of the files, (n,); None if not kept.
        values: The numbers, (n,).
    """

    stamps_ns: Integers | None
    log_times_ns: Integers | None
    places: Integers | None
    values: Numbers

    def picked(self, which: Integers | Claims) -> JointSamples:
        """Return some of the samples."""
        stamps, log_times, places = (
            None if part is None else part[which] for part in (self[0], self[1], self[2])
        )
        return JointSamples(stamps, log_times, places, self.values[which])


def merged(parts: Sequence[JointSamples]) -> JointSamples:
    """Join samples of several groups, in no order."""
    clocks: list[Integers | None] = []
    for clock in zip(*(part[:3] for part in parts), strict=True):
        known = [times for times in clock if times is not None]
        clocks.append(np.concatenate(known) if len(known) == len(parts) else None)
    stamps, log_times, places = clocks
    values = np.concatenate([part.values for part in parts])
    return JointSamples(stamps, log_times, places, values)
