"""Files that packages carry, found and read.

Nothing is imported to find out: a data package may print, or pull in what it belongs to.

The same names work in a source checkout, after a plain ``pip install`` (which puts the folder
below the environment's prefix) and in a ROS installation (below the ament prefix).
"""

from __future__ import annotations

import importlib.util
import os
import re
import stat
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from hpid_ros.base.errors import HpidError, SettingError

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
