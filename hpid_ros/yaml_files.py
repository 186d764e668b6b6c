"""Reads YAML files, with one-line errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from hpid_ros.errors import HpidError


def load_yaml(path: str | Path, error: type[HpidError]) -> Any:
    """Return what a YAML file says.

    Args:
        path: The file.
        error: The error that a bad file raises.

    Raises:
        HpidError: The ``error`` given: the file is not there, cannot be read, or is no YAML.
    """
    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as cause:
        raise error(f"cannot read {path}: {(cause.strerror or str(cause)).lower()}") from None
    except UnicodeDecodeError:
        raise error(f"cannot read {path}: it is not UTF-8 text") from None
    except yaml.YAMLError as cause:
        mark = getattr(cause, "problem_mark", None)
        place = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(cause, "problem", None) or "not YAML"
        raise error(f"cannot read {path}:{place} {problem}") from None
