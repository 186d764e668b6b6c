"""Batches on the workers of a Dask scheduler: tasks out, records as they come.

A task travels with the files of its robots, and a worker checks that it computes as the client
would before it runs one. joblib's backend for Dask is not used: what it scatters is gone with the
worker that held it, and a run that is lost has no name there.
"""

from __future__ import annotations

import asyncio
import atexit
import hashlib
import re
import shutil
import tempfile
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import hpid_bench
import hpid_ros
from hpid_bench.experiment.batch import RunRecord, RunRecords, RunTask, WorldKeeper, attempted
from hpid_bench.experiment.result_folder import versions
from hpid_ros.base.errors import HpidError, RunError, SettingError
from hpid_ros.base.files import write_file
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.base.text import shown
from hpid_ros.robot.description import RobotDescription, find_mesh

Parcel = dict[str, bytes]  # files that runs need: contents by name, which tells its content


def pack(tasks: Sequence[RunTask]) -> tuple[list[RunTask], Parcel]:
    """Put the robots of runs into a parcel, and let the runs name them by their names there."""
    parcel: Parcel = {}

    @cache
    def name(robot: str) -> str:
        return _put(RobotDescription.load(robot), parcel)

    return [_with_robots(task, name) for task in tasks], parcel


def _put(robot: RobotDescription, parcel: Parcel) -> str:
    """Add a robot and its collision meshes to a parcel, and return its name there."""
    root = ElementTree.fromstring(robot.xml)
    for mesh in root.findall("link/collision/geometry/mesh"):
        found = find_mesh(mesh.get("filename", ""), robot.folder)
        if found is not None:
            mesh.set("filename", _added(parcel, found.read_bytes(), found.suffix.lower()))
    return _added(parcel, ElementTree.tostring(root, encoding="utf-8"), ".urdf")


def _added(parcel: Parcel, content: bytes, suffix: str) -> str:
    name = f"{_digest(content)}{suffix}"
    parcel[name] = content
    return name


@cache
def _depot() -> Path:
    """Return where this process puts down what parcels hold, until it ends."""
    folder = Path(tempfile.mkdtemp(prefix="hpid-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def unpack(parcel: Parcel, task: RunTask) -> RunTask:
    """Return a run whose robots are files of this machine."""
    folder = _depot()
    for name, content in parcel.items():
        path = folder / Path(name).name
        if not path.exists():
            write_file(path, content)  # whole or not at all: threads of a worker share the folder
    return _with_robots(task, lambda robot: str(folder / Path(robot).name))


def _with_robots(task: RunTask, name: Callable[[str], str]) -> RunTask:
    world = replace(task.world, robot_description=name(str(task.world.robot_description)))
    loops = []
    for each in task.loops:
        if each.model.description:
            model = replace(each.model, description=name(each.model.description))
            each = replace(each, model=model)
        loops.append(each)
    return replace(task, world=world, loops=tuple(loops))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


_COMPUTING = ("hpid_ros", "python", "numpy", "pin")
_SOURCES = "sources of hpid_ros"
_keeper, _alone = WorldKeeper(), threading.Lock()  # an engine's warnings are the process's own


@cache
def traits(engines: tuple[str, ...]) -> Mapping[str, str]:
    """Return what decides numbers beside a task: versions, and a digest of our own sources.

    Python counts by its minor version, which also decides whether tasks can be read.
    """
    counted = {*_COMPUTING, *engines}
    found = {name: version for name, version in versions().items() if name in counted}
    found["python"] = found["python"].rpartition(".")[0]
    found["scipy"] = metadata.version("scipy")
    sources = hashlib.sha256()
    for package in (hpid_ros, hpid_bench):
        (folder,) = package.__path__
        root = Path(folder)
        for path in sorted(root.rglob("*.py")):
            sources.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return found | {_SOURCES: sources.hexdigest()[:12]}


def version_differences(own: Mapping[str, str], others: Mapping[str, str]) -> str:
    """Say what of a client a worker has not, or in another version."""
    return ", ".join(
        f"{name} {others[name]} instead of {version}" if name in others else f"no {name}"
        for name, version in own.items()
        if others.get(name) != version
    )


def work(parcel: Parcel, wanted: Mapping[str, str], task: RunTask) -> RunRecord:
    found = version_differences(wanted, traits((task.world.engine,)))
    if found:
        raise RunError(f"it has {found}")
    run = unpack(parcel, task)
    with _alone:
        return attempted(run, _keeper)


_ADDRESS = re.compile(
    r"(?:(?:tcp|tls)://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]+):(?P<port>\d{1,5})"
)
_LARGEST_PORT = 65_535
_ANSWERS_WITHIN = 10.0  # [s]


class Cluster(AbstractContextManager["Cluster"]):
    """The workers of a scheduler. It runs batches: call it with tasks.

    A worker that is lost gives its runs to the others; a worker that comes later takes part.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._client = _connect(address)
        try:  # those that come later are looked at as they work
            for worker, found in self._client.run(traits, (), on_error="return").items():
                if isinstance(found, Exception):  # it has no hpid_ros
                    raise RunError(f"the worker at {worker} cannot take part: {found}")
                unlike = version_differences(traits(()), found)
                if unlike:
                    raise RunError(f"the worker at {worker} cannot take part: it has {unlike}")
        except BaseException:
            self.close()
            raise

    def __exit__(self, *error: object) -> None:
        self.close()

    def __str__(self) -> str:
        workers = dict(self._client.scheduler_info(n_workers=-1)["workers"])
        count = f"{len(workers)} worker{'s' * (len(workers) != 1)}" if workers else "no worker yet"
        has_page = "dashboard" in self._client.scheduler_info()["services"]
        page = f"; dashboard: {self._client.dashboard_link}" if has_page else ""
        return f"{count} at {self._address}{page}"

    def __call__(self, tasks: Mapping[Any, RunTask]) -> RunRecords:
        """Run tasks, as :func:`~hpid_bench.experiment.batch.run_batch` does."""
        from distributed import as_completed

        packed, parcel = pack(list(tasks.values()))
        if not packed:
            return
        # A task of its own, so that a worker that has lost the parcel is given it again.
        name = _digest(" ".join(sorted(parcel)).encode())
        files = self._client.submit(dict, parcel, key=f"hpid-files-{name}")
        futures = {}
        for key, task in zip(tasks, packed, strict=True):
            own = traits((task.world.engine,))
            futures[self._client.submit(work, files, own, task, pure=False)] = key
        left = len(futures)
        ended: Any = as_completed
        try:
            for future in ended(list(futures), loop=self._client.loop):
                raise_if_interrupted()
                left -= 1
                key = futures[future]
                yield key, self._record(future, tasks[key].label, left)
                future.release()
        finally:
            if self._client.status == "running":
                self._client.cancel(list(futures))

    def _record(self, future: Any, label: str, left: int) -> Any:
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker:
            raise RunError(
                f"{label}: every worker that took this run was lost; --resume carries a study on"
            ) from None
        except RunError as error:
            raise RunError(f"a worker of {self._address} cannot take part: {error}") from None
        except (CancelledError, asyncio.CancelledError):  # all are when the scheduler is lost
            raise RunError(
                f"the scheduler at {self._address} is lost, and {left + 1} runs with it; "
                "--resume carries a study on"
            ) from None
        except Exception as error:  # as of a run that it cannot read
            line = " ".join(f"{type(error).__name__}: {error}".split())
            raise RunError(
                f"the scheduler or a worker at {self._address} cannot take part: {line}"
            ) from None

    def close(self) -> None:
        """Let go of the scheduler; runs that workers have begun end by themselves."""
        self._client.close(timeout=2)


def _connect(address: str) -> Any:
    place = _ADDRESS.fullmatch(address)
    if not place or int(place["port"]) > _LARGEST_PORT:
        raise SettingError(f"--scheduler must be tcp://HOST:PORT, not {address!r}")
    try:
        from distributed import Client
    except ImportError as error:
        raise SettingError(
            f"--scheduler needs Dask ({error}): pip install 'hpid_ros[cluster]'"
        ) from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions, which are compared here
        try:
            # First, because a client that meets no scheduler waits long, also to end.
            asyncio.run(asyncio.wait_for(_identity(address), _ANSWERS_WITHIN))
            connect: Any = Client
            return connect(address, timeout=_ANSWERS_WITHIN, set_as_default=False, name="hpid")
        except HpidError:
            raise
        except (OSError, asyncio.TimeoutError):  # which is no OSError before Python 3.11
            raise SettingError(
                f"--scheduler: no Dask scheduler answers at {address} within {_ANSWERS_WITHIN:g} s"
            ) from None
        except Exception as error:  # whatever distributed makes of an answer that is none of Dask
            if isinstance(error, TypeError) and address.startswith("tls://"):
                raise SettingError(
                    "tls:// needs certificates: distributed.comm.tls in Dask's configuration"
                ) from None
            raise SettingError(
                f"--scheduler: what answers at {address} is no Dask scheduler "
                f"({type(error).__name__})"
            ) from None


async def _identity(address: str) -> None:
    from distributed import Security
    from distributed.core import rpc

    connect: Any = rpc
    secure: Any = Security
    how = secure().get_connection_args("client")  # of Dask's configuration, as a client has it
    remote = connect(address, timeout=_ANSWERS_WITHIN, connection_args=how)
    try:
        kind = str((await remote.identity())["type"])
    finally:
        await remote.close_rpc()
    if kind != "Scheduler":
        raise SettingError(f"--scheduler: at {address} is no Dask scheduler, but a {shown(kind)}")
