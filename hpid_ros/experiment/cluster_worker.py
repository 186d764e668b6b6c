"""What a Dask worker does: it checks that it computes as the client would, and runs a task."""

from __future__ import annotations

import atexit
import hashlib
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import hpid_ros
from hpid_ros.base.errors import RunError
from hpid_ros.control.settings import LoopSettings
from hpid_ros.experiment.batch import Outcome, RunTask, WorldKeeper, outcome_of
from hpid_ros.experiment.result_folder import versions
from hpid_ros.robot.description import RobotDescription, find_mesh

_PARCEL = "parcel:"

Naming = Callable[[str | Path], str]


@dataclass(frozen=True)
class Parcel:
    """Files that runs need."""

    files: Mapping[str, bytes]  # contents by name; a name tells its content

    @property
    def name(self) -> str:
        """A name that tells what is in it."""
        return _digest(" ".join(sorted(self.files)).encode())

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(map(len, self.files.values()))


def pack(tasks: Sequence[RunTask]) -> tuple[list[RunTask], Parcel]:
    """Put the robots of runs into a parcel."""
    files: dict[str, bytes] = {}
    known: dict[str, str] = {"": ""}

    def name(robot: str | Path) -> str:
        key = str(robot)
        if key not in known:
            known[key] = _PARCEL + _put(RobotDescription.load(robot), files)
        return known[key]

    packed = [_with_robots(task, name) for task in tasks]
    return packed, Parcel(files)


def _put(robot: RobotDescription, files: dict[str, bytes]) -> str:
    """Add a robot and its collision meshes to files, and return its name there."""
    root = ElementTree.fromstring(robot.xml)
    for mesh in root.findall("link/collision/geometry/mesh"):
        found = find_mesh(mesh.get("filename", ""), robot.folder)
        if found is not None:
            content = found.read_bytes()
            place = f"{_digest(content)}{found.suffix.lower()}"
            files[place] = content
            mesh.set("filename", place)
    text = ElementTree.tostring(root, encoding="utf-8")
    place = f"{_digest(text)}.urdf"
    files[place] = text
    return place


class Depot:
    """Where this process puts down what parcels hold, until it ends."""

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._lock = threading.Lock()

    def unpack(self, parcel: Parcel, task: RunTask) -> RunTask:
        """Return a run whose robots are files of this machine."""
        with self._lock:
            folder = self._folder or self._begin()
            for name, content in parcel.files.items():
                path = folder / Path(name).name
                if not path.exists():
                    path.write_bytes(content)
        return _with_robots(
            task,
            lambda robot: str(folder / str(robot).removeprefix(_PARCEL)) if robot else "",
        )

    def _begin(self) -> Path:
        self._folder = Path(tempfile.mkdtemp(prefix="hpid-"))
        atexit.register(shutil.rmtree, self._folder, ignore_errors=True)
        return self._folder


def _with_robots(task: RunTask, name: Naming) -> RunTask:
    world = replace(task.world, robot_description=name(task.world.robot_description))
    return replace(task, world=world, loops=tuple(_with_robot(each, name) for each in task.loops))


def _with_robot(settings: LoopSettings, name: Naming) -> LoopSettings:
    model = settings.model
    if not model.description:
        return settings
    return replace(settings, model=replace(model, description=name(model.description)))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


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
