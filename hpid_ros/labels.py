"""Labels of controllers and names of experiments: plain names, since files are called by them."""

from __future__ import annotations

from hpid_ros.errors import HpidError
from hpid_ros.foreign_text import shown

_LONGEST = 48  # characters; with what is added to it a file's name stays below 255 bytes
_MARKS = frozenset(" -_.+=,()")

RULE = (
    "letters, digits, spaces and - _ . + = , ( ), beginning with a letter or digit, "
    f"at most {_LONGEST} characters"
)
"""What a label is, in words."""


def is_label(text: object) -> bool:
    """Tell whether something is a label.

    Args:
        text: Anything.
    """
    return (
        isinstance(text, str)
        and 0 < len(text) <= _LONGEST
        and text[0].isalnum()
        and text == text.strip()
        and all(character.isalnum() or character in _MARKS for character in text)
    )


def require_label(text: object, where: str, error: type[HpidError]) -> str:
    """Return a label that is one.

    Args:
        text: The label.
        where: Its place, for the message, for instance ``"compare"`` or ``"--group"``.
        error: The error that any other text raises.

    Raises:
        HpidError: The ``error`` given: it is none.
    """
    if not is_label(text):
        came = shown(repr(text) if len(str(text)) <= 60 else f"{str(text)[:57]!r}...")
        raise error(f"{where}: a name must be {RULE}, not {came}")
    return str(text)
