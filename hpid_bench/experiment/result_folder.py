"""Result folders: written next to the former result, marked, replaced only by themselves.

A file of its own, the marker, lists what the package wrote. ``--force`` replaces only a folder
that has one, and removes nothing but the files that it lists. The new result is written into a
folder inside the old one, and each of its files takes its place by ``os.replace`` when all are
written: a run that fails or is interrupted leaves the former result as it was, and its own bags
where they are.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from hpid_ros import __version__
from hpid_ros.base.errors import ExperimentError, HpidError, ResultExistsError
from hpid_ros.base.files import write_file

if TYPE_CHECKING:
    from typing_extensions import Self

MARKER = "hpid_result.json"
"""Name of the file that makes a folder a result of this package, and lists what it wrote."""

EXPERIMENT = "experiment.yaml"  # name of the copy of the experiment file

_PARTS = ("numpy", "pybullet", "mujoco", "pin", "rosbags", "ros-rclpy", "rclpy", "ros-fastrtps")
_FORMAT = 1
_NAMES_SHOWN = 5
_NOT_OURS = "this package did not write it"
_log = logging.getLogger(__name__)


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that compute."""
    found = {"hpid_ros": __version__, "python": platform.python_version()}
    for name in _PARTS:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


@contextmanager
def system_errors(what: str, kind: type[HpidError] = ExperimentError) -> Iterator[None]:
    """Turn an error of the operating system into one line."""
    try:
        yield
    except HpidError:  # one of them is an OSError, too
        raise
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise kind(f"{what}: {reason}") from None


@dataclass
class Marker:
    """What a result's marker says; names are relative to the folder, with slashes."""

    files: set[str] = field(default_factory=set)  # that the package wrote
    folders: set[str] = field(default_factory=set)  # that a run was writing to
    is_finished: bool = False  # whether the run came to its end

    @classmethod
    def read(cls, folder: Path) -> Marker | None:
        """Return the marker of a folder; None if it has none."""
        file = folder / MARKER
        if file.is_symlink() or not file.is_file():
            return None
        try:
            saved = json.loads(file.read_text(encoding="utf-8"))
            if saved["format"] != _FORMAT:
                raise ResultExistsError(
                    f"{file} has format {saved['format']!r}; this version knows {_FORMAT}"
                )
            files, folders = (set(map(_inside, saved[key])) for key in ("files", "folders"))
            return cls(files, folders, saved["state"] == "finished")
        except (ValueError, KeyError, TypeError, RecursionError):
            raise ResultExistsError(
                f"{file} is damaged: what the package wrote there is not known, so nothing is "
                "replaced"
            ) from None

    def write(self, folder: Path) -> None:
        document = {
            "about": "Written by hpid_ros: --force removes the files listed here and no others.",
            "hpid_ros": __version__,
            "format": _FORMAT,
            "state": "finished" if self.is_finished else "unfinished",
            "files": sorted(self.files),
            "folders": sorted(self.folders),
        }
        write_file(folder / MARKER, json.dumps(document, indent=1) + "\n")

    def all_files(self, folder: Path) -> set[str]:
        """Return the files that are there, with all in the folders that a run was writing to."""
        files = {e for e in self.files if (folder / e).is_file() and not _has_link(folder, e)}
        for each in self.folders:
            if not _has_link(folder, each):
                files.update(_files_in(folder, folder / each))
        return files


class ResultFolder:
    """Places in the folder of one result; finished when its ``with`` block ends without error."""

    path: Path  # the folder in which they are

    def __init__(self, path: Path, output: Path, former: Marker | None = None) -> None:
        self.path = path
        self._output, self._former = output, former
        self._marker = Marker()
        if former is not None and path == output:
            self._marker = Marker(former.files, former.folders)

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        force: bool = False,
        inputs: Iterable[Path] = (),
        option: str = "--output",
    ) -> Self:
        """Make the folder; within the former result where that is to be replaced."""
        former = check_place(path, force=force, inputs=inputs, option=option)
        with system_errors(f"cannot make the result folder {path}"):
            place = path
            if former is None:
                place.mkdir(parents=True, exist_ok=True)
            else:
                prefix = f"unfinished-{datetime.now():%Y%m%d-%H%M%S}-"
                place = Path(tempfile.mkdtemp(prefix=prefix, dir=path))
                place.chmod(path.stat().st_mode & 0o7777)
            folder = cls(place, path, former)
            folder._marker.write(place)
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
        path = self.path / name
        with system_errors(f"cannot write {path}"):
            self._claim(self._marker.files, name)
            path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def folder(self, name: str, *, is_made: bool = False) -> Path:
        """Return a folder of which everything is ours."""
        path = self.path / name
        with system_errors(f"cannot make {path}"):
            self._claim(self._marker.folders, name)
            if is_made:
                path.mkdir(parents=True, exist_ok=True)
        return path

    def write(self, name: str, content: str | bytes) -> None:
        path = self.file(name)
        with system_errors(f"cannot write {path}"):
            write_file(path, content)

    def bag(self, label: str) -> Path:
        return self.folder(f"bags/{label}")

    def nodes(self, label: str) -> Path:
        """Return the existing folder of a run's parameter files and logs."""
        return self.folder(f"nodes/{label}", is_made=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            with system_errors(
                f"the new result is in {self.path}; it could not be moved to {self._output}, "
                "which may still hold the former one"
            ):
                written = self._marker.all_files(self.path)
                if self.path != self._output:
                    self._take_place(written)
                Marker(written, is_finished=True).write(self._output)
            self.path = self._output
        elif self.path != self._output:
            _log.warning(
                "the former result in %s is as it was; what was run is in %s",
                self._output,
                self.path,
            )

    def _claim(self, names: set[str], name: str) -> None:
        if name in names and not _has_link(self.path, name):
            return
        if _is_in_the_way(self.path, name):
            raise ResultExistsError(f"{self.path / name} is there already: {_NOT_OURS}")
        names.add(name)
        self._marker.write(self.path)

    def _take_place(self, written: set[str]) -> None:
        """Remove the former result's files and move the new ones to where they were."""
        output, folders = self._output, self._marker.folders
        former = self._former.all_files(output) if self._former is not None else set()
        for name in sorted(written - former):
            if _is_in_the_way(output, name):
                raise ResultExistsError(
                    f"{output / name} is in the way: {_NOT_OURS}; the new result is in {self.path}"
                )
        self._correct_paths(written)
        # Whatever happens from here on, it stays known which files are ours.
        Marker(former | written).write(output)
        for name in former - written:
            if not _has_link(output, name):
                (output / name).unlink()
        _remove_empty(output, former)
        for name in sorted(written):
            (output / name).parent.mkdir(parents=True, exist_ok=True)
            (self.path / name).replace(output / name)
        (self.path / MARKER).unlink()
        _remove_empty(self.path, {MARKER} | written | {f"{each}/file" for each in folders})
        foreign = sorted(set(_files_in(output, output)) - written - {MARKER})
        if foreign:
            names = ", ".join(foreign[:_NAMES_SHOWN])
            more = len(foreign) - _NAMES_SHOWN
            names += f" and {more} more" if more > 0 else ""
            _log.warning(
                "%s also holds files that are not part of the result; they were kept: %s",
                output,
                names,
            )

    def _correct_paths(self, written: Iterable[str]) -> None:
        """Let the nodes' parameter files name their robots by where these will be."""
        before, after = str(self.path.resolve()), str(self._output.resolve())
        for name in written:
            if "nodes" in PurePosixPath(name).parts[:-1] and name.endswith(".yaml"):
                text = (self.path / name).read_text(encoding="utf-8")
                if before in text:
                    write_file(self.path / name, text.replace(before, after))


def check_place(path: Path, *, force: bool, inputs: Iterable[Path], option: str) -> Marker | None:
    """Refuse a place for a result that is no place for one, before anything is run."""
    if not os.path.lexists(path):
        return None
    if path.is_symlink():
        raise ResultExistsError(f"{path} is a symbolic link; name the folder itself")
    if not path.is_dir():
        raise ResultExistsError(f"{path} is no folder; name another with {option}")
    with system_errors(f"cannot look at {path}"):
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
        if place.resolve().is_relative_to(folder):
            relation = "is" if folder == place.resolve() else "holds"
            raise ResultExistsError(
                f"{path} {relation} {what}; a result needs a folder of its own, name one with "
                f"{option}"
            )


def _inside(name: object) -> str:
    """Return a name from a marker, which may be anybody's, if it stays inside the folder."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise ValueError(f"{name!r} is no name")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name or name == ".":
        raise ValueError(f"{name!r} leads elsewhere")
    return name


def _on_the_way(folder: Path, name: str) -> list[Path]:
    """Return the folders between a folder and a name in it."""
    return [folder / parent for parent in list(PurePosixPath(name).parents)[:-1]]


def _has_link(folder: Path, name: str) -> bool:
    """Return whether a name, or a folder on the way to it, is a symbolic link."""
    return any(each.is_symlink() for each in (folder / name, *_on_the_way(folder, name)))


def _is_in_the_way(folder: Path, name: str) -> bool:
    """Return whether a name is taken, or cannot be reached by real folders alone."""
    return os.path.lexists(folder / name) or any(
        each.is_symlink() or (each.exists() and not each.is_dir())
        for each in _on_the_way(folder, name)
    )


def _files_in(root: Path, folder: Path) -> Iterator[str]:
    """Yield the files in a folder by name relative to the root; links are not followed."""
    for place, _, names in os.walk(folder):
        for path in (Path(place, name) for name in names):
            if path.is_file() and not path.is_symlink():
                yield path.relative_to(root).as_posix()


def _remove_empty(root: Path, files: Iterable[str]) -> None:
    """Remove the folders that held these files and are empty now, the innermost first."""
    folders = {root / parent for name in files for parent in PurePosixPath(name).parents}
    for folder in sorted(folders, key=lambda each: len(each.parts), reverse=True):
        with suppress(OSError):  # which is what a link, or a folder with something in it, gives
            folder.rmdir()
