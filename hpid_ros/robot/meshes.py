"""Places of the meshes of a URDF."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hpid_ros.base.resources import is_file, package_folder

_FILE, _PACKAGE = "file://", "package://"


def find_mesh(filename: str, folder: Path | None) -> Path | None:
    """Return the file that a mesh element names.

    A ``package://name/path`` is looked for as ``path`` and as ``name/path`` in the URDF's folder
    and in those above it, which finds it in a source tree as in an install space, and then in
    the package of that name. Any other name is an absolute path or relative to the URDF.
    """
    for path in _places(filename, folder):
        if is_file(path):
            return path.absolute()
    return None


def mesh_places(filename: str, folder: Path | None) -> str:
    """Say where a mesh was looked for, for a message."""
    if filename.startswith(_PACKAGE):
        name = filename.removeprefix(_PACKAGE).partition("/")[0]
        known = package_folder(name)
        package = f"in package {name}" if known else f"there is no package {name}"
        return package if folder is None else f"{package}; not near {folder}"
    if folder is None and not Path(filename.removeprefix(_FILE)).is_absolute():
        return "relative to a URDF that came as text"
    return f"looked in {folder}" if folder else "looked there"


def _places(filename: str, folder: Path | None) -> Iterator[Path]:
    if not filename.startswith(_PACKAGE):
        plain = Path(filename.removeprefix(_FILE))
        if folder is not None or plain.is_absolute():
            yield plain if folder is None else folder / plain
        return
    plain_name = filename.removeprefix(_PACKAGE)
    name, _, below = plain_name.partition("/")
    if folder is not None:
        for base in (folder, *folder.parents):
            yield from (base / plain_name, base / below)
    package = package_folder(name)
    if package is not None:
        yield package / below
