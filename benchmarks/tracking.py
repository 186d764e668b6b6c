"""The experiment that every loop here runs: smooth motions, shortened or changed where said."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_ros.base.resources import find_resource


def tracking(
    physics_steps: int | None = None, duration: float | None = None, engine: str = ""
) -> Experiment:
    """Return the experiment of tracking.yaml."""
    experiment = _load()
    if engine:
        experiment = replace(experiment, world=replace(experiment.world, engine=engine))
    if physics_steps is not None:
        experiment = replace(
            experiment, world=replace(experiment.world, physics_steps=physics_steps)
        )
    return experiment if duration is None else replace(experiment, duration=duration)


@cache
def _load() -> Experiment:
    return load_experiment(find_resource("config/experiments/tracking.yaml"))
