"""Checked access to the sections of a configuration: every key known, every value in range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, unknown_name

_MISSING: Any = object()


class Bounds(NamedTuple):
    """The range of a number; each bound is off where it is infinite."""

    above: float = -math.inf  # it must be greater than this
    least: float = -math.inf  # it must not be less than this
    most: float = math.inf  # it must not be greater than this
    below: float = math.inf  # it must be less than this

    def hold(self, value: float) -> bool:
        """Tell whether a number is within them, and finite."""
        try:
            is_finite = math.isfinite(value)
        except OverflowError:  # of a whole number beyond every double
            return False
        is_low = self.above < value and self.least <= value
        return is_finite and is_low and value <= self.most and value < self.below

    def __str__(self) -> str:
        words = [
            f"{word} {bound:g}"
            for word, bound in zip(("above", "at least", "at most", "below"), self, strict=True)
            if math.isfinite(bound)
        ]
        return " and ".join(words) or "finite"

    def schema(self) -> dict[str, float]:
        """Return them as JSON Schema."""
        words = ("exclusiveMinimum", "minimum", "maximum", "exclusiveMaximum")
        pairs = zip(words, self, strict=True)
        return {word: bound for word, bound in pairs if math.isfinite(bound)}


ANY = Bounds()
"""Every finite number."""


class Section:
    """A mapping whose entries are taken one by one; what is left over is unknown."""

    def __init__(self, values: object, where: str, error: type[HpidError]) -> None:
        self.error = error
        self.where = where
        if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
            raise error(f"{where or 'the document'} must be a mapping, not {shown(values)}")
        self._values = dict(values)
        self._taken: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def place(self, key: str) -> str:
        """Return the dotted place of an entry."""
        return f"{self.where}.{key}" if self.where else key

    def take(self, key: str, default: Any = _MISSING) -> Any:
        """Return an entry as it stands."""
        self._taken.add(key)
        if key in self._values:
            return self._values[key]
        if default is _MISSING:
            raise self.error(f"{self.place(key)} is missing")
        return default

    def number(
        self,
        key: str,
        default: Any = _MISSING,
        *,
        above: float = -math.inf,
        least: float = -math.inf,
        most: float = math.inf,
        bounds: Bounds | None = None,
    ) -> float:
        """Return a finite number."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(f"{self.place(key)} must be a number, not {shown(value)}")
        bounds = bounds or Bounds(above, least, most)
        if not bounds.hold(value):
            raise self.error(f"{self.place(key)} must be {bounds}, not {value}")
        return float(value)

    def whole(
        self,
        key: str,
        default: Any = _MISSING,
        *,
        least: float = -math.inf,
        most: float = 2**62,
        bounds: Bounds | None = None,
    ) -> int:
        """Return a whole number in a range."""
        value = self.take(key, default)
        bounds = bounds or Bounds(least=least, most=most)
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not (whole and bounds.hold(value)):
            raise self.error(
                f"{self.place(key)} must be a whole number{_inserted(bounds)}, not {shown(value)}"
            )
        return int(value)

    def text(self, key: str, default: Any = _MISSING) -> str:
        """Return a text that is not empty."""
        value = self.take(key, default)
        if not isinstance(value, str) or not value:
            raise self.error(f"{self.place(key)} must be a text, not {shown(value)}")
        return value

    def flag(self, key: str, default: Any = _MISSING) -> bool:
        """Return true or false."""
        value = self.take(key, default)
        if not isinstance(value, bool):
            raise self.error(f"{self.place(key)} must be true or false, not {shown(value)}")
        return value

    def section(self, key: str, default: Any = _MISSING) -> Section:
        """Return a mapping inside this one."""
        return Section(self.take(key, default), self.place(key), self.error)

    @property
    def values(self) -> dict[str, Any]:
        """All entries as they stand; none is taken."""
        return dict(self._values)

    def items(self) -> dict[str, Any]:
        """Return all entries as they stand; all are taken."""
        self._taken.update(self._values)
        return dict(self._values)

    def finish(self) -> None:
        """Refuse what nobody took."""
        for key in self._values:
            if key not in self._taken:
                raise self.error(
                    unknown_name("key", self.place(key), map(self.place, self._taken))
                )


def _inserted(bounds: Bounds) -> str:
    """Return bounds as part of a sentence; nothing where there are none."""
    text = str(bounds if bounds.most < 2**62 else bounds._replace(most=math.inf))
    return "" if text == "finite" else f", {text}"


def shown(value: object) -> str:
    """Return a value for a message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
