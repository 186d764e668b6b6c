"""Reads YAML files, with one-line errors, and documents that extend others."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hpid_ros.base.errors import HpidError, unknown_name
from hpid_ros.base.resources import is_file, read_text, share_folder
from hpid_ros.base.yaml_text import dump_yaml

EXTENDS = "extends"
"""The key that names the file that a document extends."""

LARGEST_FILE = 16 << 20
"""Bytes of a file."""
MOST_LEVELS = 64
"""Levels of a document; ours have six."""
MOST_NODES = 1_000_000
"""Values of a document, those that an alias stands for counted again."""

MOST_EXTENDED = 16
"""Files that extend each other, one after the other; ours are three."""
LONGEST_KEY = 18
"""Characters of an integer that is a key: all below 2^61 - 1 have hashes of their own, while a
mapping of its multiples takes the square of their number."""
LONGEST_NUMBER = 1000
"""Characters of a number; Python refuses to write integers of more than 4300 digits."""

_SHARED = "config/experiments"
_LONGEST_REASON = 200
_BAD_VALUES = (ValueError, TypeError, LookupError, AttributeError)
"""What PyYAML lets escape for ``!!int ''``, ``!!bool x``, a 13th month or 5000 digits."""


class Document(NamedTuple):
    """What a file says together with all that it extends."""

    values: Any  # the merged document, without EXTENDS
    text: str  # the file as it stands where it extends nothing, else the merged document as YAML
    files: tuple[Path, ...]  # the file, then what it extends, and so on
    path: Path  # the file, as it was named
    origins: Mapping[str, Path]  # the file that each entry comes from, by the entry's dotted place

    @property
    def folders(self) -> tuple[Path, ...]:
        """Where files that the document names are looked for: beside each of its files."""
        return tuple(dict.fromkeys(file.parent for file in self.files))

    def blamed(self, line: str) -> Path:
        """Return the file in which the entry stands that an error is about; else the upper one."""
        line = line.removeprefix("unknown key '")
        places = [each for each in self.origins if _begins_with(line, each)]
        if not places:
            return self.path
        place = max(places, key=len)
        named = re.match(r": (?:unknown [\w ]+ ')?([\w-]+)", line[len(place) :])
        inner = f"{place}.{named[1]}" if named else place
        return self.origins.get(inner, self.origins[place])

    @contextmanager
    def blaming(self, kind: type[HpidError]) -> Iterator[None]:
        """Raise what the block raises as an error that names the file of the entry."""
        try:
            yield
        except HpidError as error:
            raise kind(f"{self.blamed(str(error))}: {error}") from None


def load_yaml(path: str | Path, error: type[HpidError]) -> Any:
    """Return what a YAML file says."""
    return parse_yaml(path, _read(path, error), error)


def load_document(path: str | Path, error: type[HpidError]) -> Document:
    """Return what a YAML file says together with what it extends.

    A mapping with ``extends: FILE`` is laid over the document of that file, which is looked for
    beside it, then in the share folder, there also among the experiments: mappings are merged
    key by key, everything else is replaced, and ``null`` removes a key. The file may extend
    another one in turn.
    """
    return _load(Path(path), (), error)


def _load(path: Path, extending: tuple[Path, ...], error: type[HpidError]) -> Document:
    file = Path(os.path.realpath(path))  # Path.resolve raises where links go round in a circle
    if file in extending:
        chain = " -> ".join(each.name for each in (*extending, file))
        raise error(f"{extending[0]}: {EXTENDS} goes round in a circle: {chain}")
    if len(extending) >= MOST_EXTENDED:
        raise error(f"{extending[0]}: {EXTENDS}: more than {MOST_EXTENDED} files in a row")
    text = _read(path, error)
    values = parse_yaml(path, text, error)
    if not isinstance(values, Mapping) or EXTENDS not in values:
        return Document(values, text, (file,), path, {})
    base = _load(_extended(values[EXTENDS], file, error), (*extending, file), error)
    if not isinstance(base.values, Mapping):
        raise error(f"{file}: {EXTENDS}: {base.files[0]} is not a mapping")
    changes = {key: value for key, value in values.items() if key != EXTENDS}
    try:
        merged = _merged(base.values, changes, "", error)
    except error as refusal:
        raise error(f"{file}: {refusal}") from None
    dumped = dump_yaml(merged)
    lowest = dict.fromkeys(_places(base.values), base.path)
    origins = {**lowest, **base.origins, **dict.fromkeys(_places(changes), path)}
    return Document(merged, dumped, (file, *base.files), path, origins)


def _places(values: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Yield the dotted place of each entry, those of mappings within it too."""
    for key, value in values.items():
        place = f"{where}.{key}" if where else str(key)
        yield place
        if isinstance(value, Mapping):
            yield from _places(value, place)


def _begins_with(line: str, place: str) -> bool:
    """Return whether a line begins with a place, and not with a longer word."""
    rest = line[len(place) :]
    return line.startswith(place) and not (rest[:1].isalnum() or rest.startswith("_"))


def _extended(name: object, file: Path, error: type[HpidError]) -> Path:
    """Return the file that another one extends."""
    if not isinstance(name, str) or not name:
        raise error(f"{file}: {EXTENDS} must name one file, not {name!r}")
    share = share_folder()
    places = [file.parent / name, share / name, share / _SHARED / name]
    for place in places:
        if is_file(place):
            return place
    folders = dict.fromkeys(str(place.parent) for place in places)
    raise error(
        f"{file}: {EXTENDS}: there is no file {name:.{_LONGEST_REASON}} "
        f"(looked in {', '.join(folders):.{_LONGEST_REASON * 2}})"
    )


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
    return read_text(Path(path), LARGEST_FILE, error).replace("\r\n", "\n")


def parse_yaml(path: str | Path, text: str, error: type[HpidError]) -> Any:
    """Return what a text says; ``path`` is what errors call it, else as :func:`load_yaml`."""
    try:
        return _document(text)
    except yaml.YAMLError as cause:
        mark = getattr(cause, "problem_mark", None)
        place = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(cause, "problem", None) or "not YAML"
        raise error(f"cannot read {path}:{place} {problem}") from None
    except _BAD_VALUES as cause:
        reason = " ".join(str(cause).split())[:_LONGEST_REASON]
        raise error(f"cannot read {path}: a value is not what its tag says ({reason})") from None


def _document(text: str) -> Any:
    """Parse a text after its size as a tree is known."""
    fast = getattr(yaml, "CSafeLoader", None)
    if fast is not None:
        # On errors the other parser, whose messages are the better ones, has the word.
        with suppress(yaml.YAMLError):
            _require_bounded(yaml.parse(text, fast))
            return yaml.load(text, fast)
    _require_bounded(yaml.parse(text, yaml.SafeLoader))
    return yaml.safe_load(text)


def _require_bounded(events: Iterator[Any]) -> None:
    """Refuse a document that is too deep, too large once its aliases are expanded, or endless.

    Parsers give events one after the other, however deep they are nested; what builds a document
    of them calls itself for each level, and whoever walks through it meets an alias as often as it
    is named.
    """
    nodes = 0
    sizes: dict[str, int] = {}
    opened: list[tuple[str | None, int]] = []
    long: set[str] = set()  # anchors of integers that are too long for keys
    keys: list[bool | None] = []  # of each that is open: whether a key is next; None in a sequence
    for event in events:
        is_key = bool(keys and keys[-1])
        if keys and keys[-1] is not None and isinstance(event, yaml.NodeEvent):
            keys[-1] = not is_key
        if is_key and _is_long(event, long):
            raise _refusal(f"a number of more than {LONGEST_KEY} characters as a key", event)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise _refusal(f"alias {event.anchor!r} is part of itself or unknown", event)
            nodes += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, nodes))
            keys.append(True if isinstance(event, yaml.MappingStartEvent) else None)
            nodes += 1
            sizes.pop(event.anchor, None)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = opened.pop()
            keys.pop()
            if anchor is not None:
                sizes[anchor] = nodes - before
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
                if _is_long(event, long):
                    long.add(event.anchor)
            if len(event.value) > LONGEST_NUMBER and _may_be_a_number(event):
                raise _refusal(f"a number of more than {LONGEST_NUMBER} characters", event)
        if len(opened) > MOST_LEVELS:
            raise _refusal(f"more than {MOST_LEVELS} levels", event)
        if nodes > MOST_NODES:
            raise _refusal(f"more than {MOST_NODES} values, aliases expanded", event)


def _is_long(event: Any, long: Collection[str]) -> bool:
    """Tell whether a scalar, or what an alias stands for, is an integer too long for a key."""
    if isinstance(event, yaml.AliasEvent):
        return event.anchor in long
    return (
        isinstance(event, yaml.ScalarEvent)
        and len(event.value) > LONGEST_KEY
        and "." not in event.value
        and _may_be_a_number(event)
    )


def _may_be_a_number(event: Any) -> bool:
    """Tell whether a scalar may be a number: one word without quotes, or what is tagged as one."""
    is_word = event.value[0] in "+-0123456789" and event.value.isascii() and " " not in event.value
    return is_word and (event.implicit[0] or event.tag is not None)


def _refusal(problem: str, event: Any) -> yaml.YAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
