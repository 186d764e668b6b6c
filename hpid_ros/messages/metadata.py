"""What ``metadata.yaml`` says of a bag, and what this package's recorder adds to it.

A recorder that was slower than what it recorded, or frozen for a while, knows from the middleware
how many messages it never got. Where it stood still for longer than a publisher's lease (an hour
with the profile of an experiment, else 20 s) the two forget each other, and nobody counts: how
long it stood still is recorded, too. The stamps of a stream show all that as gaps, where they are
regular.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from hpid_ros.base.errors import BagError
from hpid_ros.base.yaml_files import load_yaml

_Content = TypeVar("_Content", dict[str, Any], list[Any])

METADATA = "metadata.yaml"
_KEY = "rosbag2_bagfile_information"


def read_metadata(folder: Path) -> Mapping[str, Any]:
    path = folder / METADATA
    if not path.is_file():
        raise BagError(f"{METADATA} is {'no file' if path.exists() else 'missing'}")
    found = path.stat()
    return _metadata_of(path, (found.st_ino, found.st_mtime_ns, found.st_size))


@lru_cache(maxsize=16)
def _metadata_of(path: Path, version: tuple[int, ...]) -> dict[str, Any]:
    """Return what a file says as it is now: a bag's label is looked up before it is opened."""
    document = load_yaml(path, BagError)
    metadata = document.get(_KEY) if isinstance(document, Mapping) else None
    if not isinstance(metadata, dict):
        raise BagError(f"cannot read {path}: it does not say {_KEY}")
    return metadata


def custom_data(bag: Path) -> dict[str, str]:
    """Return the texts that a recording was given; none for a damaged one.

    A single file has those of the folder in which it is, if that folder's metadata name it.
    """
    folder = bag if bag.is_dir() else bag.parent
    try:
        metadata = read_metadata(folder)
    except BagError:  # what is wrong with a bag is said when it is read
        return {}
    return {} if folder is not bag and bag.name not in files_of(metadata) else texts_of(metadata)


def texts_of(metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return the own entries that are texts, as all that rosbag2 writes are."""
    custom = metadata.get("custom_data")
    entries = custom.items() if isinstance(custom, Mapping) else ()
    return {k: v for k, v in entries if isinstance(k, str) and isinstance(v, str)}


def files_of(metadata: Mapping[str, Any]) -> set[str]:
    named = metadata.get("relative_file_paths")
    return {Path(str(name)).name for name in named} if isinstance(named, list) else set()


def counts_of(metadata: Mapping[str, Any]) -> dict[str, int]:
    """Return how many messages of each topic the metadata counts."""
    counts: dict[str, int] = {}
    try:
        for each in metadata["topics_with_message_count"]:
            name, count = each["topic_metadata"]["name"], int(each["message_count"])
            counts[str(name)] = counts.get(str(name), 0) + count
    except (KeyError, TypeError, ValueError, OverflowError):
        return {}
    return counts


MISSED_ENTRY = "hpid_ros/missed_messages"
"""Name of the entry with the counts: JSON, by topic."""

STOOD_STILL_ENTRY = "hpid_ros/stood_still"
"""Name of the entry with the time that the recorder stood still, in [s]."""


def missed_entries(missed: Mapping[str, int], stood_still: float) -> dict[str, str]:
    counts = json.dumps(dict(missed), sort_keys=True)
    return {MISSED_ENTRY: counts, STOOD_STILL_ENTRY: f"{stood_still:.3f}"}


def missed_messages(metadata: Mapping[str, str]) -> dict[str, int]:
    """Return the messages that a bag's recorder missed, by topic; only those that missed some."""
    entry = _parsed(metadata, MISSED_ENTRY, dict)
    return {topic: count for topic, count in entry.items() if type(count) is int and count > 0}


def time_stood_still(metadata: Mapping[str, str]) -> float:
    """Return how long a bag's recorder stood still, in [s]; zero if it did not or did not say."""
    try:
        seconds = float(metadata.get(STOOD_STILL_ENTRY, "0"))
    except ValueError:
        return 0.0
    return seconds if math.isfinite(seconds) and seconds > 0.0 else 0.0


SLIDES_ENTRY = "hpid_ros/slides"
"""Name of the entry with the joints that slide, whose units are m and N: JSON, a list."""


def slides_entry(slides: Collection[str]) -> dict[str, str]:
    """Return the entry for the metadata; none where no joint slides."""
    return {SLIDES_ENTRY: json.dumps(sorted(slides))} if slides else {}


def recorded_slides(metadata: Mapping[str, str]) -> frozenset[str]:
    """Return the joints that a bag's recorder knew to slide."""
    return frozenset(
        each for each in _parsed(metadata, SLIDES_ENTRY, list) if isinstance(each, str)
    )


def _parsed(metadata: Mapping[str, str], name: str, kind: type[_Content]) -> _Content:
    """Return the content of an entry of JSON; an empty one where there is none of that kind."""
    try:
        content = json.loads(str(metadata.get(name)))
    except (ValueError, RecursionError):
        return kind()
    return content if isinstance(content, kind) else kind()


CONTROLLERS_ENTRY = "hpid_ros/controllers"
"""Name of the entry with the parameters of the controllers as they began: a ROS parameter file."""
