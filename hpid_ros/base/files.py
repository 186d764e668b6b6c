"""Files that packages carry and files that commands write.

Nothing is imported to find out: a data package may print, or pull in what it belongs to.

The same names work in a source checkout, after a plain ``pip install`` (which puts the folder
below the environment's prefix) and in a ROS installation (below the ament prefix).
"""

from __future__ import annotations

import errno
import importlib.util
import json
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hpid_ros.base.errors import HpidError, ResultExistsError, SettingError


def refuse_output(path: Path, *, force: bool, inputs: Iterable[Path], option: str) -> None:
    """Refuse a file that is in the way, or cannot be made, before any work is done for it."""
    if not os.path.lexists(path):
        folder = next(each for each in path.absolute().parents if os.path.lexists(each))
        if not folder.is_dir():
            raise SettingError(f"cannot write {path}: {folder} is no folder")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise SettingError(f"cannot write {path}: permission denied in {folder}")
        return
    if path.is_dir():
        raise ResultExistsError(f"{path} is a folder; name a file with {option}")
    for each in inputs:
        place = each.resolve()
        if place == path.resolve() or place in path.resolve().parents:
            what = "an input" if place == path.resolve() else f"part of the input {each}"
            raise ResultExistsError(f"{path} is {what}; name another file with {option}")
    if not force:
        raise ResultExistsError(
            f"{path} exists; name another with {option} or replace it with --force"
        )


def refuse_outputs(
    outputs: Iterable[tuple[str, Path | None]], *, force: bool, inputs: Iterable[Path]
) -> None:
    """Refuse files that are in the way, or in each other's, as :func:`refuse_output` does."""
    read, taken = list(inputs), dict[Path, str]()
    for option, path in outputs:
        if path is None:
            continue
        other = taken.setdefault(path.resolve(), option)
        if other != option:
            raise SettingError(f"{other} and {option} must name different files, not both {path}")
        refuse_output(path, force=force, inputs=read, option=option)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file; what was there stays as it was unless all of it could be written."""
    raw = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_symlink() or (path.exists() and not path.is_file()):  # for instance /dev/stdout
        path.write_bytes(raw)
        return
    beside = path.with_name(f".{path.name[:40]}-{secrets.token_hex(4)}.part")
    try:
        with beside.open("xb") as file:
            file.write(raw)
        if path.exists():
            beside.chmod(path.stat().st_mode & 0o7777)
        beside.replace(path)
    except BaseException as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename, error.filename2 = str(path), None  # what the person has named
        raise


@contextmanager
def finished_folder(path: Path) -> Iterator[Path]:
    """Give the place of a new folder, which takes its name when the block has ended without error.

    Until then it lies next to that name, in a folder called ``NAME.unfinished-...``: whatever
    interrupts the block leaves nothing of the name itself. What is there already stays.

    Raises:
        FileExistsError: If there is something of that name, at the end as at the beginning.
    """
    if os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, "it exists already", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    around = Path(tempfile.mkdtemp(prefix=f"{path.name[:40]}.unfinished-", dir=path.parent))
    try:
        yield around / path.name
        if os.path.lexists(path):  # since then
            raise FileExistsError(errno.EEXIST, "it exists already", str(path))
        (around / path.name).rename(path)
    finally:
        shutil.rmtree(around, ignore_errors=True)


_LONGEST_REASON = 200
_AMENT_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


_KINDS = {
    stat.S_IFIFO: "FIFO",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
    stat.S_IFDIR: "folder",
}


def other_kind(path: Path) -> str:
    """Return what something is that is no regular file; empty if it is one, or is not there.

    What is read of a FIFO or a device has no end, or no beginning.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except OSError:
        return ""
    return "" if kind == stat.S_IFREG else _KINDS.get(kind, "special file")


def read_text(path: Path, most: int, error: type[HpidError] = SettingError) -> str:
    """Return the text of a regular file of no more than so many bytes."""
    try:
        if kind := other_kind(path):
            raise error(f"cannot read {path}: it is a {kind}, not a file")
        with path.open("rb") as stream:
            raw = stream.read(min(path.stat().st_size, most) + 1)
        if len(raw) > most:
            raise error(f"cannot read {path}: it has more than {most} bytes")
        return raw.decode("utf-8")
    except OSError as cause:
        raise error(f"cannot read {path}: {(cause.strerror or str(cause)).lower()}") from None
    except UnicodeDecodeError:
        raise error(f"cannot read {path}: it is not UTF-8 text") from None


LARGEST_JSON = 64 << 20
"""Bytes of a JSON file."""


def load_json(path: Path, most: int = LARGEST_JSON) -> Any:
    """Return what a JSON file says."""
    text = read_text(path, most)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SettingError(f"{path} is no JSON: {str(error)[:_LONGEST_REASON]}") from None


def package_folder(name: str) -> Path | None:
    """Return the folder that ``package://name`` stands for."""
    if not _AMENT_NAME.fullmatch(name):
        return None
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        share = Path(prefix) / "share" / name
        if prefix and (share / "package.xml").is_file():
            return share
    return _python_package(name)


def package_uri(path: Path) -> str:
    """Return the ``package://`` name of a file in a package, else its absolute path.

    A text with such names means the same on every machine that has the package.
    """
    for folder in path.parents:
        if package_folder(folder.name) == folder:
            return f"package://{folder.name}/{path.relative_to(folder).as_posix()}"
    return str(path)


def _python_package(name: str) -> Path | None:
    if not name.isidentifier() or name in sys.builtin_module_names:
        return None
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # a module that is imported and has no spec
        return None
    if spec is None or spec.origin is None:  # a mere folder on the path is no package
        return None
    places = spec.submodule_search_locations
    return Path(next(iter(places))).resolve() if places else None


_PACKAGE = "hpid_ros"
_SCHEME = "package://"


class ResourceError(HpidError, FileNotFoundError):
    """A file that is neither where it was said to be nor in the package's share folder."""


def share_folder() -> Path:
    """Return the folder that holds this package's config, urdf and launch files."""
    for folder in _candidates():
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise ResourceError(f"the share folder of {_PACKAGE} is not installed")


def _candidates() -> Iterator[Path]:
    yield Path(__file__).resolve().parents[2]
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]:
        if prefix:
            yield Path(prefix) / "share" / _PACKAGE


def is_file(path: Path) -> bool:
    """Return whether there is a file; there is none of a name that is too long for one."""
    try:
        return path.is_file()
    except OSError:
        return False


def find_resource(name: str, beside: Sequence[Path] = ()) -> Path:
    """Return the file of this name."""
    places = list(_places(name, beside))
    for path in places:
        if is_file(path):
            return path.resolve()
    raise ResourceError(f"there is no file {name} ({_list(places, name)})")


def _places(name: str, beside: Sequence[Path]) -> Iterator[Path]:
    """Yield the files that a name may mean, the likeliest first."""
    relative = name.removeprefix(_SCHEME)
    package, _, below = relative.partition("/")
    if relative == name:
        yield from (folder / name for folder in beside)
        yield Path(name)
        yield share_folder() / name
    elif package == _PACKAGE:
        yield share_folder() / below
        return
    folder = package_folder(package) if below else None
    if folder is not None:
        yield folder / below


def _list(places: list[Path], name: str) -> str:
    """Say where a name was looked for."""
    looked = ", ".join(dict.fromkeys(str(path.absolute().parent) for path in places))
    if not looked:
        package = name.removeprefix(_SCHEME).partition("/")[0]
        return f"there is no ament or Python package {package}"
    return f"looked in {looked}"
