"""Files that commands write, and JSON."""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hpid_ros.base.errors import ResultExistsError, SettingError
from hpid_ros.base.resources import read_text


def refuse_output(path: Path, *, force: bool, inputs: Iterable[Path], option: str) -> None:
    """Refuse a file that is in the way, or cannot be made, before any work is done for it."""
    if not os.path.lexists(path):
        folder = next(each for each in path.absolute().parents if os.path.lexists(each))
        if not folder.is_dir():
            raise SettingError(f"cannot write {path}: {folder} is no folder")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise SettingError(f"cannot write {path}: permission denied in {folder}")
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


@contextmanager
def finished_folder(path: Path) -> Iterator[Path]:
    """Give the place of a new folder, which takes its name when the block has ended without error.

    Until then it lies next to that name, in a folder called ``NAME.unfinished-...``: whatever
    interrupts the block leaves nothing of the name itself. What is there already stays.

    Raises:
        FileExistsError: If there is something of that name, at the end as at the beginning.
    """
    if os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, "it exists already", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    around = Path(tempfile.mkdtemp(prefix=f"{path.name[:40]}.unfinished-", dir=path.parent))
    try:
        yield around / path.name
        if os.path.lexists(path):  # since then
            raise FileExistsError(errno.EEXIST, "it exists already", str(path))
        (around / path.name).rename(path)
    finally:
        shutil.rmtree(around, ignore_errors=True)


_LONGEST_REASON = 200


LARGEST_JSON = 64 << 20
"""Bytes of a JSON file."""


def load_json(path: Path, most: int = LARGEST_JSON) -> Any:
    """Return what a JSON file says."""
    text = read_text(path, most)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SettingError(f"{path} is no JSON: {str(error)[:_LONGEST_REASON]}") from None
