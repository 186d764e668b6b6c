"""What a worker does: it makes sure that it computes as the client would, and runs a task."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import hpid_ros
from hpid_ros.base.errors import RunError
from hpid_ros.experiment.result.folder import versions
from hpid_ros.studies.batch import Outcome, RunTask, WorldKeeper, outcome_of
from hpid_ros.studies.cluster.parcel import Depot, Parcel

_COMPUTING = ("hpid_ros", "python", "numpy", "pin")
_SOURCES = "sources of hpid_ros"
_depot = Depot()
_of_thread = threading.local()  # a world is one thread's own


@cache
def traits(engines: tuple[str, ...]) -> Mapping[str, str]:
    """Return what decides numbers beside a task: versions, and a digest of our own sources.

    Python counts by its minor version, which also decides whether tasks can be read.
    """
    counted = {*_COMPUTING, *engines}
    found = {name: version for name, version in versions().items() if name in counted}
    found["python"] = found["python"].rpartition(".")[0]
    root = Path(hpid_ros.__file__).parent
    sources = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        sources.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return found | {_SOURCES: sources.hexdigest()[:12]}


def differences(own: Mapping[str, str], others: Mapping[str, str]) -> str:
    """Say what of a client a worker has not, or in another version."""
    return ", ".join(
        f"{name} {others[name]} instead of {version}" if name in others else f"no {name}"
        for name, version in own.items()
        if others.get(name) != version
    )


def work(parcel: Parcel, wanted: Mapping[str, str], place: int, task: RunTask) -> Outcome:
    """Run a task on this worker."""
    found = differences(wanted, traits((task.world.engine,)))
    if found:
        raise RunError(f"it has {found}")
    if not hasattr(_of_thread, "keeper"):
        _of_thread.keeper = WorldKeeper()
    return outcome_of(place, _depot.unpack(parcel, task), _of_thread.keeper)
