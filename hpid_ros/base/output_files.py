"""Writing a file that a person named: nothing else is touched, nothing is left half written."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from hpid_ros.base.errors import ResultExistsError, SettingError


def refuse_output(path: Path, *, force: bool, inputs: Iterable[Path], option: str) -> None:
    """Refuse a file that is in the way, before any work is done for it."""
    if not os.path.lexists(path):
        return
    if path.is_dir():
        raise ResultExistsError(f"{path} is a folder; name a file with {option}")
    for each in inputs:
        place = each.resolve()
        if place == path.resolve() or place in path.resolve().parents:
            what = "an input" if place == path.resolve() else f"part of the input {each}"
            raise ResultExistsError(f"{path} is {what}; name another file with {option}")
    if not force:
        raise ResultExistsError(
            f"{path} exists; name another with {option} or replace it with --force"
        )


def refuse_outputs(
    outputs: Iterable[tuple[str, Path | None]], *, force: bool, inputs: Iterable[Path]
) -> None:
    """Refuse files that are in the way, or in each other's, as :func:`refuse_output` does."""
    read, taken = list(inputs), dict[Path, str]()
    for option, path in outputs:
        if path is None:
            continue
        other = taken.setdefault(path.resolve(), option)
        if other != option:
            raise SettingError(f"{other} and {option} must name different files, not both {path}")
        refuse_output(path, force=force, inputs=read, option=option)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file; what was there stays as it was unless all of it could be written."""
    raw = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_symlink() or (path.exists() and not path.is_file()):  # for instance /dev/stdout
        path.write_bytes(raw)
        return
    beside = path.with_name(f".{path.name[:40]}-{secrets.token_hex(4)}.part")
    try:
        with beside.open("xb") as file:
            file.write(raw)
        if path.exists():
            beside.chmod(path.stat().st_mode & 0o7777)
        beside.replace(path)
    except BaseException as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename, error.filename2 = str(path), None  # what the person has named
        raise
