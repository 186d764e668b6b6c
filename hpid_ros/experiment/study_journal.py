"""The runs of a study on disk: written as they end, read again to carry on or to look at them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hpid_ros.analysis import RunIndices
from hpid_ros.analysis.quantities import CHATTER, ERROR_MAX, OVERSHOOT, Quantity
from hpid_ros.errors import RunError
from hpid_ros.experiment.judged_run import LAST_ERROR, PAPER_QUANTITIES
from hpid_ros.experiment.study_plan import RunKey

QUANTITIES: tuple[Quantity, ...] = (
    *PAPER_QUANTITIES,
    OVERSHOOT,
    ERROR_MAX,
    CHATTER,
    LAST_ERROR,
)
"""What a study keeps of a run."""

TOTAL = ""
"""Stands for all judged joints where a joint's name would be."""


@dataclass(frozen=True)
class RunRecord:
    """What is kept of one run.

    Attributes:
        key: Which run.
        digest: SHA-256 of all that decides its numbers but the seed.
        numbers: Of each joint, and of all under :data:`TOTAL`, by the quantity's key; what is
            not defined is left out. Empty if the run failed.
        failure: Why it failed, in one line; empty if it did not.
    """

    key: RunKey
    digest: str
    numbers: Mapping[str, Mapping[str, float]]
    failure: str = ""

    @classmethod
    def of(
        cls,
        key: RunKey,
        digest: str,
        indices: RunIndices | None,
        failure: str,
    ) -> RunRecord:
        """Return the record of a run that has ended."""
        numbers = {} if indices is None else _numbers(indices)
        return cls(key, digest, numbers, failure)

    def line(self) -> str:
        """Return the record as one line of JSON."""
        return json.dumps(
            {
                **self.key._asdict(),
                "sha256": self.digest,
                "numbers": self.numbers,
                "failure": self.failure,
            }
        )

    @classmethod
    def parse(cls, line: str) -> RunRecord:
        """Return the record that :meth:`line` wrote.

        Raises:
            ValueError: It is none.
        """
        try:
            saved = json.loads(line)
            key = RunKey(saved["experiment"], saved["controller"], int(saved["seed"]))
            return cls(key, saved["sha256"], saved["numbers"], saved["failure"])
        except (KeyError, TypeError) as error:
            raise ValueError(f"no record of a run: {error}") from None


def read_journal(path: Path) -> list[RunRecord]:
    """Return the records of a journal; a last line that was cut off is left out.

    Args:
        path: The file; one that is not there has no records.

    Raises:
        RunError: Another line is damaged.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    records = []
    for number, line in enumerate(lines, 1):
        try:
            records.append(RunRecord.parse(line))
        except ValueError:
            if number == len(lines):
                break
            raise RunError(f"{path}: line {number} is damaged") from None
    return records


def _numbers(indices: RunIndices) -> dict[str, dict[str, float]]:
    """Return the numbers to keep; nan, what is not defined, is left out."""
    found = {}
    for joint in (*indices.joints, None):
        values = {q.key: indices.value(q, joint) for q in QUANTITIES}
        known = {key: value for key, value in values.items() if value == value}
        found[TOTAL if joint is None else joint] = known
    return found
