"""Sources of numbers: bags, result folders and saved numbers, each with its label."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hpid_ros.bags.metadata import custom_data
from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import is_label

RESULT = "result.json"
LABEL = "label"
"""Name of a bag's label among its metadata (custom_data)."""


@dataclass(frozen=True)
class Source:
    """One thing to read."""

    path: Path  # a bag, or a file of saved numbers
    label: str | None = None  # what it is called; None if it says so itself

    @property
    def is_saved(self) -> bool:
        """Whether it holds numbers and no recording."""
        return self.path.suffix == ".json"


def expanded(source: Source) -> list[Source]:
    """Return the bags of a result folder, its saved numbers if they are gone, or the source."""
    if not (source.path / RESULT).is_file():
        return [source]
    document = load_json(source.path / RESULT)
    indices = document.get("indices") if isinstance(document, dict) else None
    labels = list(indices.get("runs", {})) if isinstance(indices, dict) else []
    # The file may be anybody's: a name that is no label does not lead to a bag of this folder.
    if not all(map(is_label, labels)):
        return [Source(source.path / RESULT, source.label)]
    bags = [Source(source.path / "bags" / label, source.label or label) for label in labels]
    if not bags or not all(bag.path.exists() for bag in bags):
        return [Source(source.path / RESULT, source.label)]
    return bags


def labelled(sources: Sequence[Source]) -> list[Source]:
    """Give labels to bags without one: their metadata's, else as much of the path as differs."""
    labels = [
        each.label or (None if each.is_saved else _label_in_metadata(each.path))
        for each in sources
    ]
    nameless = [e.path for e, label in zip(sources, labels, strict=True) if label is None]
    names = dict(zip(nameless, _distinct_names(nameless), strict=True))
    return [
        each if each.is_saved else replace(each, label=label or names[each.path])
        for each, label in zip(sources, labels, strict=True)
    ]


def saved_parameters(bag: Path) -> Mapping[str, Mapping[str, object]]:
    """Return what the controllers of a bag in a result folder were set to, by joint and name."""
    result = bag.absolute().parent.parent / RESULT
    if bag.absolute().parent.name != "bags" or not result.is_file():
        return {}
    document = load_json(result)
    parameters = document.get("parameters") if isinstance(document, dict) else None
    found = parameters.get(bag.name) if isinstance(parameters, dict) else None
    if not isinstance(found, dict):
        return {}
    return {joint: each for joint, each in found.items() if isinstance(each, dict)}


def load_json(path: Path) -> Any:
    """Return what a JSON file says."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot read {path}: {reason}") from None
    except (ValueError, RecursionError) as error:
        raise SettingError(f"{path} is no JSON: {error}") from None


def _label_in_metadata(path: Path) -> str | None:
    label = custom_data(path).get(LABEL)
    return label if isinstance(label, str) and label else None


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    parts = [path.absolute().with_suffix("").parts for path in paths]
    for depth in range(1, max((len(part) for part in parts), default=0) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(set(parts)):
            return names
    return [part[-1] for part in parts]
