"""Recorded runs of a result folder, with the world in which they ran."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from hpid_ros.bags.run.reader import read_run
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.documents.yaml_files import load_document
from hpid_ros.metrics.sources import RESULT, Source, expanded
from hpid_ros.recordings.series import RunSeries
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world_file import world_of

_ENGINES = "engines.json"


class Recorded(NamedTuple):
    """Runs and their world."""

    world: WorldSettings
    runs: tuple[RunSeries, ...]  # the runs, in the result's order
    bags: dict[str, Path]  # the recording of each, by label


def recorded(result: Path, labels: Sequence[str] = ()) -> Recorded:
    """Return the runs of a result."""
    bags = _bags(result)
    for label in labels:
        if label not in bags:
            raise SettingError(f"{result}: {unknown_name('run', label, bags)}")
    chosen = {label: bags[label] for label in labels or bags}
    world = _world(result / "nodes" / next(iter(chosen)) / "world.yaml")
    selection = BagSelection(joints=world.joints)
    runs = tuple(read_run(bag, label, selection=selection) for label, bag in chosen.items())
    return Recorded(world, runs, chosen)


def _bags(result: Path) -> dict[str, Path]:
    if (result / _ENGINES).is_file():
        raise SettingError(f"{result} is of several engines: name one of its folders")
    if not (result / RESULT).is_file():
        raise SettingError(f"{result} is no result folder: it has no {RESULT}")
    sources = expanded(Source(result))
    if any(each.is_saved for each in sources):
        raise SettingError(f"{result} has no recordings any more, or other labels than theirs")
    return {each.label or each.path.name: each.path for each in sources}


def _world(file: Path) -> WorldSettings:
    document = load_document(file, SettingError)
    return world_of(document.values, document).world
