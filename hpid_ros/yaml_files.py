"""Reads YAML files, with one-line errors, and documents that extend others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hpid_ros.errors import HpidError, unknown_name
from hpid_ros.resources import share_folder

EXTENDS = "extends"
"""The key that names the file that a document extends."""

_SHARED = "config/experiments"


class Document(NamedTuple):
    """What a file says together with all that it extends.

    Attributes:
        values: The merged document, without :data:`EXTENDS`.
        text: The file as it stands where it extends nothing, else the merged document as YAML.
        files: The file, then what it extends, then what that extends, ...
    """

    values: Any
    text: str
    files: tuple[Path, ...]

    @property
    def folders(self) -> tuple[Path, ...]:
        """Where files that the document names are looked for: beside each of its files."""
        return tuple(dict.fromkeys(file.parent for file in self.files))


def load_yaml(path: str | Path, error: type[HpidError]) -> Any:
    """Return what a YAML file says.

    Args:
        path: The file.
        error: The error that a bad file raises.

    Raises:
        HpidError: The ``error`` given: the file is not there, cannot be read, or is no YAML.
    """
    return _parsed(path, _read(path, error), error)


def load_document(path: str | Path, error: type[HpidError]) -> Document:
    """Return what a YAML file says together with what it extends.

    A mapping with ``extends: FILE`` is laid over the document of that file, which is looked for
    beside it, then in the share folder, there also among the experiments: mappings are merged
    key by key, everything else is replaced, and ``null`` removes a key. The file may extend
    another one in turn.

    Args:
        path: The file.
        error: The error that a bad file raises.

    Raises:
        HpidError: The ``error`` given: a file is not there, cannot be read, is no YAML, extends
            itself in the end, or removes a key that is not there.
    """
    return _load(Path(path), (), error)


def _load(path: Path, extending: tuple[Path, ...], error: type[HpidError]) -> Document:
    file = path.resolve()
    if file in extending:
        chain = " -> ".join(each.name for each in (*extending, file))
        raise error(f"{extending[0]}: {EXTENDS} goes round in a circle: {chain}")
    text = _read(path, error)
    values = _parsed(path, text, error)
    if not isinstance(values, Mapping) or EXTENDS not in values:
        return Document(values, text, (file,))
    base = _load(_extended(values[EXTENDS], file, error), (*extending, file), error)
    if not isinstance(base.values, Mapping):
        raise error(f"{file}: {EXTENDS}: {base.files[0]} is not a mapping")
    changes = {key: value for key, value in values.items() if key != EXTENDS}
    try:
        merged = _merged(base.values, changes, "", error)
    except error as refusal:
        raise error(f"{file}: {refusal}") from None
    dumped = yaml.safe_dump(merged, sort_keys=False, allow_unicode=True)
    return Document(merged, dumped, (file, *base.files))


def _extended(name: object, file: Path, error: type[HpidError]) -> Path:
    """Return the file that another one extends."""
    if not isinstance(name, str) or not name:
        raise error(f"{file}: {EXTENDS} must name one file, not {name!r}")
    share = share_folder()
    places = [file.parent / name, share / name, share / _SHARED / name]
    for place in places:
        if place.is_file():
            return place
    folders = dict.fromkeys(str(place.parent) for place in places)
    raise error(f"{file}: {EXTENDS}: there is no file {name} (looked in {', '.join(folders)})")


def _merged(
    base: Mapping[str, Any], changes: Mapping[str, Any], where: str, error: type[HpidError]
) -> dict[str, Any]:
    """Return a mapping with changes laid over it, its keys in its order, new ones last."""
    result = dict(base)
    for key, change in changes.items():
        place = f"{where}.{key}" if where else str(key)
        if change is None:
            if key not in result:
                known = [f"{where}.{name}" if where else str(name) for name in base]
                raise error(f"null removes nothing: {unknown_name('key', place, known)}")
            del result[key]
        elif isinstance(change, Mapping):
            below = result.get(key)
            inner = below if isinstance(below, Mapping) else {}
            result[key] = _merged(inner, change, place, error)
        else:
            result[key] = change
    return result


def _read(path: str | Path, error: type[HpidError]) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as cause:
        raise error(f"cannot read {path}: {(cause.strerror or str(cause)).lower()}") from None
    except UnicodeDecodeError:
        raise error(f"cannot read {path}: it is not UTF-8 text") from None


def _parsed(path: str | Path, text: str, error: type[HpidError]) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as cause:
        mark = getattr(cause, "problem_mark", None)
        place = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(cause, "problem", None) or "not YAML"
        raise error(f"cannot read {path}:{place} {problem}") from None
