"""Checked access to the sections of a configuration: every key known, every value in range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hpid_ros.base.errors import HpidError, unknown_name

_MISSING: Any = object()


class Section:
    """A mapping whose entries are taken one by one; what is left over is unknown.

    Args:
        values: The mapping.
        where: Its dotted place in the document, for the messages; empty for the root.
        error: The error that a bad entry raises.

    Raises:
        HpidError: The ``error`` given: ``values`` is not a mapping with texts as keys.
    """

    def __init__(self, values: object, where: str, error: type[HpidError]) -> None:
        self._error = error
        self.where = where
        if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
            raise error(f"{where or 'the document'} must be a mapping, not {_shown(values)}")
        self._values = dict(values)
        self._taken: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def place(self, key: str) -> str:
        """Return the dotted place of an entry."""
        return f"{self.where}.{key}" if self.where else key

    def take(self, key: str, default: Any = _MISSING) -> Any:
        """Return an entry as it stands.

        Raises:
            HpidError: It is missing and there is no default.
        """
        self._taken.add(key)
        if key in self._values:
            return self._values[key]
        if default is _MISSING:
            raise self._error(f"{self.place(key)} is missing")
        return default

    def number(
        self,
        key: str,
        default: Any = _MISSING,
        *,
        above: float = -math.inf,
        least: float = -math.inf,
        most: float = math.inf,
    ) -> float:
        """Return a finite number.

        Args:
            key: Its name.
            default: Taken when it is missing.
            above: It must be greater than this.
            least: It must not be less than this.
            most: It must not be greater than this.

        Raises:
            HpidError: Missing, no number, not finite, out of range.
        """
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._error(f"{self.place(key)} must be a number, not {_shown(value)}")
        if not (math.isfinite(value) and above < value and least <= value <= most):
            low = f"above {above:g}" if above > -math.inf else f"at least {least:g}"
            bounds = [low] if max(above, least) > -math.inf else []
            bounds += [f"at most {most:g}"] if most < math.inf else []
            raise self._error(
                f"{self.place(key)} must be {' and '.join(bounds) or 'finite'}, not {value}"
            )
        return float(value)

    def whole(self, key: str, default: Any = _MISSING, *, least: int, most: int = 2**62) -> int:
        """Return a whole number in a range.

        Raises:
            HpidError: Missing, not whole, out of range.
        """
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise self._error(
                f"{self.place(key)} must be a whole number of at least {least}, "
                f"not {_shown(value)}"
            )
        return value

    def text(self, key: str, default: Any = _MISSING) -> str:
        """Return a text that is not empty.

        Raises:
            HpidError: Missing, no text, or empty.
        """
        value = self.take(key, default)
        if not isinstance(value, str) or not value:
            raise self._error(f"{self.place(key)} must be a text, not {_shown(value)}")
        return value

    def flag(self, key: str, default: Any = _MISSING) -> bool:
        """Return true or false.

        Raises:
            HpidError: Missing or neither.
        """
        value = self.take(key, default)
        if not isinstance(value, bool):
            raise self._error(f"{self.place(key)} must be true or false, not {_shown(value)}")
        return value

    def section(self, key: str, default: Any = _MISSING) -> Section:
        """Return a mapping inside this one.

        Raises:
            HpidError: Missing or no mapping.
        """
        return Section(self.take(key, default), self.place(key), self._error)

    def items(self) -> dict[str, Any]:
        """Return all entries as they stand; all are taken."""
        self._taken.update(self._values)
        return dict(self._values)

    def finish(self) -> None:
        """Refuse what nobody took.

        Raises:
            HpidError: There is an entry that nothing asked for.
        """
        for key in self._values:
            if key not in self._taken:
                raise self._error(
                    unknown_name("key", self.place(key), map(self.place, self._taken))
                )


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
