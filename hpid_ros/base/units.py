"""Units: of time, whole nanoseconds in stamps and seconds elsewhere; of joints that slide."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
"""Of any shape, which the docstring says."""

Vector = tuple[float, float, float]
"""In space: x, y, z."""


NANOSECONDS = 1_000_000_000
"""Nanoseconds in one second."""

SECONDS_PER_NANOSECOND = 1e-9
"""Seconds in one nanosecond."""

_OF_SLIDES = {"N m": "N", "kg m^2": "kg", "rad": "m"}
_TURNING = re.compile(r"\bN m\b|\bkg m\^2|\brad\b")


def of_slide(text: str) -> str:
    """Return a text with the units of a prismatic joint in place of a turning one's."""
    return _TURNING.sub(lambda match: _OF_SLIDES[match[0]], text)


def unit_over(unit: str, are_slides: Iterable[bool]) -> str:
    """Return the unit of what concerns several joints; where both kinds are there, both units."""
    kinds = sorted(set(are_slides)) or [False]
    return ", ".join(dict.fromkeys(of_slide(unit) if each else unit for each in kinds))
