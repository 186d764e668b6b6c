"""What a search searches, and what it finds at one point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hpid_ros.control import LoopSettings
from hpid_ros.errors import SettingError
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.judged_run import JudgedTask
from hpid_ros.experiment.search_cost import SearchCost
from hpid_ros.experiment.search_space import SearchSpace
from hpid_ros.tuning.degree_check import DegreeChecker

LEAST_EVALUATIONS = 10
_TRAINING = 1000
"""Training seeds begin so far above the experiment's own: those of a study stay unseen."""

Loops = tuple[LoopSettings, ...]


@dataclass(frozen=True)
class Evaluation:
    """One point of a search.

    Attributes:
        number: Counted from 0.
        stage: ``all`` joints, or the one that was refined.
        values: The free parameters by name.
        loops: The controller; empty if it was refused.
        cost: Infinite if it was refused or a run failed.
        ratios: Of each index to the baseline, by key.
        last_error: Largest error of the last second over joints and seeds, in [rad].
        note: Why it has no cost, in one line.
    """

    number: int
    stage: str
    values: Mapping[str, float]
    loops: Loops
    cost: float = math.inf
    ratios: Mapping[str, float] = field(default_factory=dict)
    last_error: float = math.nan
    note: str = ""


@dataclass(frozen=True)
class SearchPlan:
    """Everything that decides what a search finds.

    Attributes:
        experiment: Gives the robot, the reference and the baseline, its first controller.
        space: What may be changed.
        cost: What is made small.
        joints: The joints that are judged.
        evaluations: Points of the search over all joints, and of each refinement of one.
        seeds: How many training seeds each point is run with.
        search_seed: Of the search itself.
        per_joint: Whether every judged joint is refined on its own after the search.
        must_be_certified: Whether degrees that are not certified are refused.
        settle: Largest error of the last second that is accepted, in [rad].

    Raises:
        SettingError: A number is out of range, or a loop's inertia is not known.
    """

    experiment: Experiment
    space: SearchSpace
    cost: SearchCost
    joints: tuple[str, ...]
    evaluations: int = 150
    seeds: int = 3
    search_seed: int = 1
    per_joint: bool = False
    must_be_certified: bool = True
    settle: float = math.inf

    def __post_init__(self) -> None:
        if self.evaluations < LEAST_EVALUATIONS:
            raise SettingError(
                f"evaluations must be at least {LEAST_EVALUATIONS}, not {self.evaluations}"
            )
        if self.seeds < 1:
            raise SettingError(f"seeds must be at least 1, not {self.seeds}")
        if not self.settle > 0.0:
            raise SettingError(f"settle must be positive, not {self.settle} rad")
        for each in self.space.start:
            reason = DegreeChecker().instability(each)
            if reason:
                raise SettingError(f"{each.joint}: {reason}")

    @property
    def training_seeds(self) -> tuple[int, ...]:
        """The seeds that points are run with."""
        return tuple(self.experiment.seed + _TRAINING + k for k in range(self.seeds))

    @property
    def total(self) -> int:
        """Points of the whole search."""
        return self.evaluations * (1 + len(self.joints) * self.per_joint)

    def tasks(self, name: str, loops: Loops) -> list[JudgedTask]:
        """Return the runs of one controller, one for each training seed."""
        experiment = self.experiment
        return [
            JudgedTask(
                f"{name} seed={seed}",
                replace(experiment.world, seed=seed),
                loops,
                experiment.trajectory,
                experiment.periods,
                self.joints,
            )
            for seed in self.training_seeds
        ]
