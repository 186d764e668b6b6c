"""Asking before something moves or is written."""

from __future__ import annotations

import sys

from hpid_ros.base.errors import SettingError


def agreed(question: str, *, is_given: bool, option: str = "--yes") -> bool:
    """Ask a person, and return whether the answer is yes.

    Args:
        question: In one line, without a question mark.
        is_given: Whether the answer was given as an option.
        option: How it is given.

    Raises:
        SettingError: There is nobody to ask.
    """
    if is_given:
        return True
    if not sys.stdin.isatty():
        raise SettingError(f"there is no terminal to ask at: {option} answers yes")
    print(f"{question}? [y/N] ", end="", flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")
