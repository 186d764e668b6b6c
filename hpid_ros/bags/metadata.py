"""What ``metadata.yaml`` of a bag's folder says, whoever wrote it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hpid_ros.errors import BagError
from hpid_ros.yaml_files import load_yaml

METADATA = "metadata.yaml"
_KEY = "rosbag2_bagfile_information"


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return the information of a bag.

    Raises:
        BagError: The file is damaged, or is none that a recorder writes.
    """
    path = folder / METADATA
    if not path.is_file():
        raise BagError(f"{METADATA} is {'no file' if path.exists() else 'missing'}")
    document = load_yaml(path, BagError)
    metadata = document.get(_KEY) if isinstance(document, Mapping) else None
    if not isinstance(metadata, dict):
        raise BagError(f"cannot read {path}: it does not say {_KEY}")
    return metadata


def custom_data(bag: Path) -> Mapping[str, object]:
    """Return the texts that a recording was given; none for a single file or a damaged one."""
    if not bag.is_dir():
        return {}
    try:
        custom = read_metadata(bag).get("custom_data")
    except BagError:  # what is wrong with a bag is said when it is read
        return {}
    return custom if isinstance(custom, Mapping) else {}


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
