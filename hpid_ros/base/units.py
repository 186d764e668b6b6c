"""Units: of time, whole nanoseconds in stamps and seconds elsewhere; of joints that slide."""

import re
from collections.abc import Iterable

NANOSECONDS = 1_000_000_000
"""Nanoseconds in one second."""

SECONDS_PER_NANOSECOND = 1e-9
"""Seconds in one nanosecond."""

_OF_SLIDES = {"N m": "N", "kg m^2": "kg", "rad": "m"}
_TURNING = re.compile(r"\bN m\b|\bkg m\^2|\brad\b")


def of_slide(text: str) -> str:
    """Return a text with the units of a prismatic joint in place of a turning one's.

    Args:
        text: With units as this package writes them: ``N m s/rad`` becomes ``N s/m``.
    """
    return _TURNING.sub(lambda match: _OF_SLIDES[match[0]], text)


def unit_over(unit: str, are_slides: Iterable[bool]) -> str:
    """Return the unit of what concerns several joints; where both kinds are there, both units.

    Args:
        unit: Where the joint turns: ``N m`` becomes ``N m, N`` over joints of both kinds.
        are_slides: Of each joint whether it slides; of none, it is a turning one's.
    """
    kinds = sorted(set(are_slides)) or [False]
    return ", ".join(dict.fromkeys(of_slide(unit) if each else unit for each in kinds))
