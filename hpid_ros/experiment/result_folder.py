"""The folder that a run leaves: made anew, never written over by accident."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from hpid_ros.errors import ExperimentError, ResultExistsError

_MARK = "experiment.yaml"
_MARKS = (_MARK, "runs.jsonl")  # of a run, a comparison or a search; of a study
_PARTS = ("bags", "figures", "nodes")


class ResultFolder:
    """Places in the folder of one result.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(
        cls, path: Path, *, force: bool = False, parts: Sequence[str] = _PARTS
    ) -> ResultFolder:
        """Make the folder.

        Args:
            path: Where; it must not exist.
            force: Replace a result that is there already. Anything else is never replaced.
            parts: Folders to make inside it.

        Raises:
            ResultExistsError: The path exists and is not to be replaced.
            ExperimentError: The folder cannot be made.
        """
        try:
            if path.exists():
                cls._remove(path, force)
            for folder in (path, *(path / part for part in parts)):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            if isinstance(error, ResultExistsError):
                raise
            raise ExperimentError(f"cannot make the result folder {path}: {reason}") from None
        return cls(path)

    @staticmethod
    def _remove(path: Path, force: bool) -> None:
        if not force:
            raise ResultExistsError(
                f"{path} exists; name another folder with --output or replace it with --force"
            )
        is_result = path.is_dir() and (
            any((path / mark).is_file() for mark in _MARKS) or not any(path.iterdir())
        )
        if not is_result:
            raise ResultExistsError(f"{path} exists and is not a result; it is not replaced")
        shutil.rmtree(path)

    @property
    def experiment(self) -> Path:
        """Copy of the experiment file."""
        return self.path / _MARK

    @property
    def figures(self) -> Path:
        """Folder of the figures."""
        return self.path / "figures"

    def bag(self, label: str) -> Path:
        """Return the folder of a run's bag."""
        return self.path / "bags" / label

    def nodes(self, label: str) -> Path:
        """Return the existing folder of a run's parameter files and logs."""
        folder = self.path / "nodes" / label
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def write(self, name: str, text: str) -> None:
        """Write one text file of the result."""
        (self.path / name).write_text(text, encoding="utf-8")
