"""Places in a result folder: of the bags, the nodes' files, the figures and everything else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hpid_ros.base.errors import ExperimentError, HpidError
from hpid_ros.base.output_files import write_file


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
