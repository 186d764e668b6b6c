"""Untrusted text, shown in one line, in figures and in CSV.

A bag, a URDF or a message can hold any character in a name: escape sequences that write a
terminal's title or clipboard, line breaks that look like a message of ours, markup, the beginning
of a spreadsheet's formula. Each way out of the package goes through one function of this module.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence

_LONGEST_LINE = 8000  # characters

_FORMULA = tuple("=+-@\uff1d\uff0b\uff0d\uff20")
"""What makes a spreadsheet take a cell for a formula; tabs and returns are shown as text."""


def shown(text: str) -> str:
    r"""Return a text in one line, what cannot be printed as its escape, for instance ``\x1b``.

    That is everything that ``repr`` would escape: control characters, line breaks, and those that
    are invisible or turn the direction of writing.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def bounded(text: str, longest: int = _LONGEST_LINE) -> str:
    """Return a text as :func:`shown`, without its middle where it is longer than people read."""
    left_out = len(text) - longest
    if left_out > 0:
        half = longest // 2
        text = f"{text[:half]} ... {left_out} characters ... {text[-half:]}"
    return shown(text)


LONGEST_NAME = 80
"""Characters of a name that a line shows."""
_SHOWN_NAMES = 10


def name_text(name: object) -> str:
    """Return a name in quotes, as ``repr``, without the rest of one that nobody would read."""
    text = str(name)
    if len(text) <= LONGEST_NAME:
        return repr(text)
    return f"{text[:LONGEST_NAME]!r}... ({len(text)} characters)"


def names_text(names: Sequence[str]) -> str:
    """Return the first of some names as :func:`name_text`, and how many more there are."""
    further = f", and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return f"[{', '.join(map(name_text, names[:_SHOWN_NAMES]))}{further}]"


class LineBudget:
    """How many lines of a log are written of what comes again and again.

    Some at once, as what begins has several things to say, and then few a second.
    """

    def __init__(self, at_once: int = 20, rate: float = 2.0) -> None:
        self._at_once, self._rate = at_once, rate
        self._left, self._at = float(at_once), 0.0
        self._left_out = 0

    def admitted(self, line: str, now: float) -> str:
        """Return a line, with how many were left out before it; empty if it is one of them."""
        self._left = min(self._left + self._rate * max(now - self._at, 0.0), self._at_once)
        self._at = now
        if self._left < 1.0:
            self._left_out += 1
            return ""
        self._left -= 1.0
        left_out, self._left_out = self._left_out, 0
        return f"{line} ({left_out} lines before it were left out)" if left_out else line


def shown_lines(text: str) -> str:
    """Return a text of several lines, each as :func:`shown`; tabs stay."""
    if text.replace("\n", "").isprintable():
        return text
    return "".join(c if c in "\n\t" else shown(c) for c in text)


def figure_text(text: str) -> str:
    """Return a text for a figure, where matplotlib takes what is between dollars for a formula."""
    return shown(text).replace("$", r"\$")


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV.

    Texts that begin as formulas (``= + - @``) get an apostrophe in front, which spreadsheets take
    as "this is text". Numbers stay numbers, whatever their sign.
    """
    import csv  # of what processes import it, few write tables

    text = io.StringIO()
    write = csv.writer(text, lineterminator="\n").writerow
    for row in rows:
        write([_cell(cell) if isinstance(cell, str) else cell for cell in row])
    return text.getvalue()


def _cell(text: str) -> str:
    text = shown(text)
    return f"'{text}" if len(text) > 1 and text.startswith(_FORMULA) else text
