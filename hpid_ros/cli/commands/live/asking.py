"""Asking before something moves or is written."""

from __future__ import annotations

import sys

from hpid_ros.base.errors import SettingError


def agreed(question: str, *, is_given: bool, option: str = "--yes") -> bool:
    """Ask a person, and return whether the answer is yes."""
    if is_given:
        return True
    if not sys.stdin.isatty():
        raise SettingError(f"there is no terminal to ask at: {option} answers yes")
    print(f"{question}? [y/N] ", end="", flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")
