"""Where packages keep their files: ament packages, and Python packages that carry data.

Nothing is imported to find out: a data package may print, or pull in what it belongs to.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from pathlib import Path

_AMENT_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


def package_folder(name: str) -> Path | None:
    """Return the folder that ``package://name`` stands for.

    Args:
        name: Name of a package.

    Returns:
        The share folder of the ament package of that name (below a prefix of
        ``AMENT_PREFIX_PATH``, the first wins), else the folder of the Python package of that
        name, for instance ``pybullet_data``; None where there is neither.
    """
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

    Args:
        path: A file.
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
