"""The bags that are finished in a folder, each told once."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from hpid_ros.errors import SettingError

_FINISHED = "metadata.yaml"
"""A recorder writes it last: without it a bag is still being recorded, or was cut off."""


class FinishedBags:
    """Looks for finished bags below a folder, at any depth; those there already are not new.

    Args:
        folder: Where to look.

    Raises:
        SettingError: It is no folder.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise SettingError(f"watch must name a folder, {folder} is none")
        self._folder = folder
        self._known = set(self._sizes())
        self._before: dict[Path, int] = {}

    def new(self) -> list[Path]:
        """Return the bags that were finished by the last call and are complete now, by name."""
        sizes = {bag: size for bag, size in self._sizes().items() if bag not in self._known}
        # A file that still grows is being written this moment.
        fresh = sorted(bag for bag, size in sizes.items() if self._before.get(bag) == size > 0)
        self._known.update(fresh)
        self._before = sizes
        return fresh

    def _sizes(self) -> dict[Path, int]:
        """Return the size of each finished bag's last file."""
        sizes = {}
        for file in self._folder.rglob(_FINISHED):
            with suppress(FileNotFoundError):  # a bag may go while it is looked at
                sizes[file.parent] = file.stat().st_size
        return sizes
