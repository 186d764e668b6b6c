"""Units of figures whose panels are joints, which turn or slide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hpid_ros.base.units import of_slide, unit_over
from hpid_ros.recordings.series import RunSeries


class JointUnits(NamedTuple):
    """Which joints of a figure slide."""

    are_slides: tuple[bool, ...]  # of each joint, in the order of the panels

    @classmethod
    def of(cls, runs: Sequence[RunSeries]) -> JointUnits:
        """Return those of the first run's joints; what one run knows holds for all."""
        slides = frozenset[str]().union(*(run.slides for run in runs))
        return cls(tuple(joint in slides for joint in runs[0].joint_names))

    def over_all(self, unit: str) -> str:
        """Return the unit of an axis that the panels share: both where both kinds are there."""
        return unit_over(unit, self.are_slides)

    def suffixes(self, unit: str) -> tuple[str, ...]:
        """Return what follows each joint's name above its panel: its unit where they differ."""
        if len(set(self.are_slides)) < 2:
            return ("",) * len(self.are_slides)
        return tuple(f" [{of_slide(unit) if each else unit}]" for each in self.are_slides)
