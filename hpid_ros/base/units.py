"""Units of time: stamps are whole nanoseconds, everything else is in seconds."""

NANOSECONDS = 1_000_000_000
"""Nanoseconds in one second."""

SECONDS_PER_NANOSECOND = 1e-9
"""Seconds in one nanosecond."""
