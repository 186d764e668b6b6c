"""Result folders: made aside, marked, replaced only by themselves.

A file of its own, the marker, lists what the package wrote. ``--force`` replaces only a folder
that has one, and removes nothing but the files that it lists. The new result is written aside, in
a folder inside the old one, and takes its place when it is finished: a run that fails or is
interrupted leaves the former result as it was, and its own bags where they are.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import TYPE_CHECKING

from hpid_ros import __version__
from hpid_ros.base.errors import ExperimentError, HpidError, ResultExistsError
from hpid_ros.base.files import write_file

if TYPE_CHECKING:
    from typing_extensions import Self


class ResultPlaces(ABC):
    """Where the parts of one result lie; what is written there is noted as this package's."""

    path: Path  # the folder in which they are

    @abstractmethod
    def file(self, name: str) -> Path:
        """Return the path of a file that is about to be written, and note that it is ours."""

    @abstractmethod
    def folder(self, name: str, *, is_made: bool = False) -> Path:
        """Return a folder of which everything is ours."""

    @property
    def figures(self) -> Path:
        """Existing folder of the figures."""
        return self.folder("figures", is_made=True)

    def bag(self, label: str) -> Path:
        """Return the folder of a run's bag."""
        return self.folder(f"bags/{label}")

    def nodes(self, label: str) -> Path:
        """Return the existing folder of a run's parameter files and logs."""
        return self.folder(f"nodes/{label}", is_made=True)

    def write(self, name: str, content: str | bytes) -> None:
        """Write one file of the result as a whole."""
        path = self.file(name)
        with told(f"cannot write {path}"):
            write_file(path, content)

    def part(self, name: str) -> ResultPart:
        """Return the places of one of several results that lie beside each other."""
        return ResultPart(self, name)


class ResultPart(ResultPlaces):
    """A result inside another one, which stands and falls with it."""

    def __init__(self, whole: ResultPlaces, name: str) -> None:
        self._whole, self._name = whole, name

    @property
    def path(self) -> Path:  # type: ignore[override]
        """Its folder, wherever the whole is."""
        return self._whole.path / self._name

    def file(self, name: str) -> Path:
        """Return the path of a file that is about to be written, as the whole does."""
        return self._whole.file(f"{self._name}/{name}")

    def folder(self, name: str, *, is_made: bool = False) -> Path:
        """Return a folder of which everything is ours, as the whole does."""
        return self._whole.folder(f"{self._name}/{name}", is_made=is_made)


@contextmanager
def told(what: str) -> Iterator[None]:
    """Turn an error of the operating system into one line."""
    try:
        yield
    except HpidError:  # one of them is an OSError, too
        raise
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ExperimentError(f"{what}: {reason}") from None


_PARTS = ("numpy", "pybullet", "mujoco", "pin", "rosbags", "ros-rclpy", "rclpy", "ros-fastrtps")


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that compute."""
    found = {"hpid_ros": __version__, "python": platform.python_version()}
    for name in _PARTS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


MARKER = "hpid_result.json"
"""Name of the file that makes a folder a result of this package, and lists what it wrote."""

EXPERIMENT = "experiment.yaml"
"""Name of the copy of the experiment file."""

_FORMAT = 1
_NAMES_SHOWN = 5
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Marker:
    """What a result's marker says."""

    # files that the package wrote, relative to the folder, with slashes
    files: frozenset[str] = frozenset()
    folders: frozenset[str] = frozenset()  # folders that a run was writing to
    is_finished: bool = False  # whether the run came to its end

    @classmethod
    def read(cls, folder: Path) -> Marker | None:
        """Return the marker of a folder; None if it has none."""
        file = folder / MARKER
        if not _is_file(file):
            return None
        try:
            saved = json.loads(file.read_text(encoding="utf-8"))
            if saved["format"] != _FORMAT:
                raise ResultExistsError(
                    f"{file} has format {saved['format']!r}; this version knows {_FORMAT}"
                )
            files, folders = (frozenset(map(_inside, saved[k])) for k in ("files", "folders"))
            return cls(files, folders, saved["state"] == "finished")
        except (ValueError, KeyError, TypeError, RecursionError):
            raise ResultExistsError(
                f"{file} is damaged: what the package wrote there is not known, so nothing is "
                "replaced"
            ) from None

    def write(self, folder: Path) -> None:
        """Write the marker into a folder."""
        document = {
            "about": "Written by hpid_ros: --force removes the files listed here and no others.",
            "hpid_ros": __version__,
            "format": _FORMAT,
            "state": "finished" if self.is_finished else "unfinished",
            "files": sorted(self.files),
            "folders": sorted(self.folders),
        }
        write_file(folder / MARKER, json.dumps(document, indent=1) + "\n")

    def expanded(self, folder: Path) -> frozenset[str]:
        """Return the files, with all that lie in the folders that a run was writing to."""
        files = {
            name
            for name in self.files
            if _is_file(folder / name) and not _leads_through_link(folder, name)
        }
        for each in self.folders:
            if not _leads_through_link(folder, f"{each}/file"):
                files.update(_files_in(folder, folder / each))
        return frozenset(files)


class ResultFolder(ResultPlaces):
    """Places in the folder of one result; finished when its ``with`` block ends without error."""

    def __init__(self, path: Path, output: Path, former: Marker | None = None) -> None:
        self.path = path
        self._output, self._former = output, former
        known = former if former is not None and path == output else Marker()
        self._files, self._folders = set(known.files), set(known.folders)

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        force: bool = False,
        inputs: Iterable[Path] = (),
        option: str = "--output",
    ) -> Self:
        """Make the folder."""
        former = check_place(path, force=force, inputs=inputs, option=option)
        with told(f"cannot make the result folder {path}"):
            place = path if former is None else _aside(path)
            place.mkdir(parents=True, exist_ok=former is None)
            folder = cls(place, path, former)
            folder._mark()
        return folder

    @classmethod
    def reopen(cls, path: Path) -> Self:
        """Return a result that is there, to be carried on in its place."""
        former = Marker.read(path)
        if former is None:
            raise ResultExistsError(f"{path} has no {MARKER}: {_NOT_OURS}")
        return cls(path, path, former)

    def file(self, name: str) -> Path:
        """Return the path of a file that is about to be written, and note that it is ours."""
        with told(f"cannot write {self.path / name}"):
            self._claim(self._files, name)
            path = self.path / name
            path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def folder(self, name: str, *, is_made: bool = False) -> Path:
        """Return a folder of which everything is ours."""
        with told(f"cannot make {self.path / name}"):
            self._claim(self._folders, name)
            path = self.path / name
            if is_made:
                path.mkdir(parents=True, exist_ok=True)
        return path

    def add(self, name: str) -> None:
        """Note a file that was just written into a folder that was empty."""
        self._files.add(name)

    def finish(self) -> None:
        """Take the place of the former result, if there is one, and say that it is finished."""
        written = Marker(frozenset(self._files), frozenset(self._folders)).expanded(self.path)
        with told(f"what was run is in {self.path}, but {self._output} cannot be finished"):
            if self._former is not None and self.path != self._output:
                self._take_place(written, self._former.expanded(self._output))
            Marker(written, is_finished=True).write(self._output)
        self.path = self._output

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.finish()
        elif self.path != self._output:
            _log.warning(
                "the former result in %s is as it was; what was run is in %s",
                self._output,
                self.path,
            )

    def _claim(self, kind: set[str], name: str) -> None:
        if name in kind and not _leads_through_link(self.path, f"{name}/itself"):
            return
        if _is_in_the_way(self.path, name):
            raise ResultExistsError(f"{self.path / name} is there already: {_NOT_OURS}")
        kind.add(name)
        self._mark()

    def _mark(self) -> None:
        Marker(frozenset(self._files), frozenset(self._folders)).write(self.path)

    def _take_place(self, written: frozenset[str], former: frozenset[str]) -> None:
        """Remove the former result's files and move the new ones to where they were."""
        output = self._output
        for name in sorted(written - former):
            if _is_in_the_way(output, name):
                raise ResultExistsError(
                    f"{output / name} is in the way: {_NOT_OURS}; the new result is in {self.path}"
                )
        self._correct_paths(written)
        # Whatever happens from here on, it stays known which files are ours.
        Marker(former | written).write(output)
        folders = {parent for name in former for parent in PurePosixPath(name).parents}
        for name in former - written:
            if not _leads_through_link(output, name):
                (output / name).unlink()
        _remove_empty(output, folders)
        for name in sorted(written):
            (output / name).parent.mkdir(parents=True, exist_ok=True)
            (self.path / name).replace(output / name)
        (self.path / MARKER).unlink()
        own = {PurePosixPath(each) for each in self._folders | written}
        _remove_empty(self.path, own.union(*(each.parents for each in own)))
        foreign = sorted(set(_files_in(output, output)) - written - {MARKER})
        if foreign:
            more = (
                f" and {len(foreign) - _NAMES_SHOWN} more" if len(foreign) > _NAMES_SHOWN else ""
            )
            names = ", ".join(foreign[:_NAMES_SHOWN])
            _log.warning("left alone in %s, not being of the result: %s%s", output, names, more)

    def _correct_paths(self, written: Iterable[str]) -> None:
        """Let the nodes' parameter files name their robots by where these will be."""
        before, after = str(self.path.resolve()), str(self._output.resolve())
        for name in written:
            if "nodes" in PurePosixPath(name).parts[:-1] and name.endswith(".yaml"):
                text = (self.path / name).read_text(encoding="utf-8")
                if before in text:
                    write_file(self.path / name, text.replace(before, after))


_NOT_OURS = "this package did not write it"


def check_place(path: Path, *, force: bool, inputs: Iterable[Path], option: str) -> Marker | None:
    """Refuse a place for a result that is no place for one, before anything is run."""
    if not os.path.lexists(path):
        return None
    if path.is_symlink():
        raise ResultExistsError(f"{path} is a symbolic link; name the folder itself")
    if not path.is_dir():
        raise ResultExistsError(f"{path} is no folder; name another with {option}")
    with told(f"cannot look at {path}"):
        _refuse_precious(path, inputs, option)
        is_empty = not any(path.iterdir())
        former = Marker.read(path)
    if is_empty:
        return None
    if former is None:
        raise ResultExistsError(
            f"{path} exists and is not a result that could be replaced: it has no {MARKER} "
            "(results of earlier versions have none); name another folder, or remove this one "
            "yourself"
        )
    if not force:
        raise ResultExistsError(
            f"{path} exists; name another folder with {option} or replace it with --force"
        )
    return former


def _refuse_precious(path: Path, inputs: Iterable[Path], option: str) -> None:
    """Refuse the folders that nobody means: those of the input, of the user, of the process."""
    places = {
        "the working directory": Path.cwd(),
        "the home folder": Path(os.path.expanduser("~")),  # noqa: PTH111 (Path raises if there is none)
    }
    places |= {f"the folder of the input {file.name}": file.absolute().parent for file in inputs}
    folder = path.resolve()
    for what, place in places.items():
        place = place.resolve()
        if folder == place or folder in place.parents:
            relation = "is" if folder == place else "holds"
            raise ResultExistsError(
                f"{path} {relation} {what}; a result needs a folder of its own, name one with "
                f"{option}"
            )


def _aside(path: Path) -> Path:
    """Return a folder that does not exist, on the same file system."""
    name = f"unfinished-{datetime.now():%Y%m%d-%H%M%S}"
    number, place = 1, path / name
    while os.path.lexists(place):
        number += 1
        place = path / f"{name}-{number}"
    return place


def _inside(name: object) -> str:
    """Return a name from a marker, which may be anybody's, if it stays inside the folder."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise ValueError(f"{name!r} is no name")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name or name == ".":
        raise ValueError(f"{name!r} leads elsewhere")
    return name


def _is_file(path: Path) -> bool:
    """Return whether there is a regular file; a symbolic link is none."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def _leads_through_link(folder: Path, name: str) -> bool:
    """Return whether a folder on the way to a name is a symbolic link."""
    parents = PurePosixPath(name).parents
    return any((folder / parent).is_symlink() for parent in parents if str(parent) != ".")


def _is_in_the_way(folder: Path, name: str) -> bool:
    """Return whether a name is taken, or cannot be reached by real folders alone."""
    if os.path.lexists(folder / name):
        return True
    above = [folder / parent for parent in PurePosixPath(name).parents]
    return any(
        os.path.lexists(each) and (each.is_symlink() or not each.is_dir()) for each in above
    )


def _files_in(root: Path, folder: Path) -> Iterator[str]:
    """Yield the files in a folder by name relative to the root; links are not followed."""
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place, name)
            if _is_file(path):
                yield path.relative_to(root).as_posix()


def _remove_empty(root: Path, folders: Iterable[PurePosixPath]) -> None:
    """Remove folders that are empty, the innermost first; a link is none."""
    for folder in sorted(folders, key=lambda each: len(each.parts), reverse=True):
        path = root / folder
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            path.rmdir()
