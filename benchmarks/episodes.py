"""One disturbed run beside the undisturbed run of the same experiment."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.disturbed_graph import SETTLE, DisturbedGraph, Fault
from benchmarks.surroundings import loopback_environment
from benchmarks.tracking import tracking
from hpid_bench.experiment.batch import RunTask, WorldKeeper, simulate_task
from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_bench.experiment.processes import NodeGroup, own_domain
from hpid_ros.base.errors import RunError, SettingError
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import JointSeries, RunSeries

LABEL = "hPID"
ANSWER_TIMEOUT = 2.0  # [s] of wall time
OTHERS_AT_MOST = 0.05  # [rad] that another joint may leave its undisturbed path
SETTLED_WITHIN = 0.02  # [rad] from the undisturbed path, SETTLE seconds after the fault
TAKEOVER_AT_MOST = 0.5  # [N m] of a first command, beyond its damping
_SAME_PERIODS_UP_TO = 600.0  # [s] of motion
_LATELY = 20  # states, over which a velocity is taken
_LAST_FAULT = 8.0  # [s] before the end
_NS = 1e9


@dataclass(frozen=True)
class Episode:
    """One disturbed run beside its undisturbed one."""

    faults: Sequence[Fault]  # what was done
    states: int  # states of the run
    unplanned: int  # joints that the bridge gave up without a fault
    # whether all positions equal those of the undisturbed run to the last bit up to the last state
    # told before the first fault
    is_equal_before: bool
    # largest distance of a joint that was not disturbed from its undisturbed path, in [rad]
    others: float
    # largest such distance of a disturbed joint, ``SETTLE`` after its return, in [rad]
    unsettled: float
    # largest first effort of a restarted controller, beyond what damps twice the joint's velocity,
    # in [N m]
    takeover: float
    longest_cycle: float  # longest wall time between two states, in [s]

    def broken(self) -> list[str]:
        """Return a line for each bound that was not kept."""
        rules = (
            (self.unplanned == 0, f"{self.unplanned} joints were given up without a fault"),
            (self.is_equal_before, "the run differs before its first fault"),
            (self.others <= OTHERS_AT_MOST, f"another joint moved {self.others:.3f} rad"),
            (self.unsettled <= SETTLED_WITHIN, f"{self.unsettled:.3f} rad off after a fault"),
            (self.takeover <= TAKEOVER_AT_MOST, f"a takeover jumped by {self.takeover:.2f} N m"),
            (self.longest_cycle <= ANSWER_TIMEOUT, f"{self.longest_cycle:.3f} s without a state"),
        )
        return [line for is_kept, line in rules if not is_kept]


def sines(folder: Path, motion: float, duration: float | None = None) -> Experiment:
    """Return tracking.yaml with slow sines about where its joints start in place of its motions.

    Motions longer than ten minutes have longer periods, so that the trajectory's message does not
    grow with them.
    """
    slower = max(1.0, motion / _SAME_PERIODS_UP_TO)
    base = tracking()
    document = load_yaml(str(base.path), SettingError)
    starts = document["robot"]["initial_positions"]
    document["duration"] = motion if duration is None else duration
    document["control"] = {"rate": 1000, "answer_timeout": ANSWER_TIMEOUT}
    document["reference"] = {
        "kind": "sine",
        "duration": motion,
        "joints": {
            joint: {
                "amplitude": 0.15,
                "period": slower * (4.0 + 0.5 * k),
                "offset": starts.get(joint, 0.0),
            }
            for k, joint in enumerate(base.world.joints)
        },
    }
    path = folder / "sines.yaml"
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    return load_experiment(path)


def undisturbed(experiment: Experiment) -> RunSeries:
    """Return the same run without a fault."""
    with WorldKeeper() as keeper:
        return simulate_task(RunTask.of(experiment, LABEL), keeper)


def run_episode(experiment: Experiment, calm: RunSeries, folder: Path, seed: int) -> Episode:
    """Run once under faults and compare."""
    folder.mkdir()
    last_ns = round((experiment.duration - _LAST_FAULT) * _NS)
    with (
        own_domain() as domain,
        NodeGroup(loopback_environment(domain), folder, is_batch=True) as group,
    ):
        graph = DisturbedGraph(
            experiment, LABEL, group, folder, folder / "bag", random.Random(seed)
        )
        graph.start()
        while not graph.is_finished:
            graph.look()
            graph.disturb_when_due(last_ns)
        finished = graph.events[graph.nodes.bridge, "finished"]
        group.stop([graph.nodes.recorder], patience=30.0)
        group.stop()
    run = read_run(folder / "bag", "disturbed")
    dampings = {loop.joint: loop.gains.d for loop in experiment.controllers[LABEL]}
    longest = finished["timing"]["cycle"]["maximum"]
    return _episode(graph, finished["states"], longest, calm, run, dampings)


def _episode(
    graph: DisturbedGraph,
    states: int,
    longest: float,
    calm: RunSeries,
    run: RunSeries,
    dampings: Mapping[str, float],
) -> Episode:
    stamps = run.joints[0].state_stamps_ns
    if not np.array_equal(stamps, calm.joints[0].state_stamps_ns):
        raise RunError(f"{len(stamps)} states were recorded of {states}")
    away = {
        one.joint: np.abs(one.position - other.position)
        for one, other in zip(run.joints, calm.joints, strict=True)
    }
    begins = [fault.begin_ns for fault in graph.faults]
    calm_until = stamps <= min(begins, default=int(stamps[-1]))
    series = {joint.joint: joint for joint in run.joints}
    return Episode(
        faults=graph.faults,
        states=states,
        unplanned=sum(not is_planned(miss, graph.faults) for miss in graph.misses),
        is_equal_before=all(not distance[calm_until].any() for distance in away.values()),
        others=max(
            float(distance[~_disturbed(joint, graph.faults, stamps)].max())
            for joint, distance in away.items()
        ),
        unsettled=max((_unsettled(fault, away, stamps) for fault in graph.faults), default=0.0),
        takeover=max(
            (
                _takeover(fault, series[fault.joint], dampings[fault.joint])
                for fault in graph.faults
            ),
            default=0.0,
        ),
        longest_cycle=longest * 1e-6,
    )


def is_planned(miss: tuple[str, int], faults: Sequence[Fault]) -> bool:
    """Tell whether a joint was given up because of a fault of its own controller."""
    joint, stamp_ns = miss
    return any(
        fault.joint == joint
        and fault.silent_ns is not None
        and fault.silent_ns <= stamp_ns
        and (fault.back_ns is None or stamp_ns <= fault.back_ns)
        for fault in faults
    )


def _disturbed(
    joint: str, faults: Sequence[Fault], stamps: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return which states are under a fault of this joint, or within ``SETTLE`` after it."""
    is_hit = np.zeros(len(stamps), dtype=np.bool_)
    for fault in faults:
        if fault.joint == joint:
            end_ns = (fault.back_ns or int(stamps[-1])) + round(SETTLE * _NS)
            is_hit |= (stamps >= fault.begin_ns) & (stamps <= end_ns)
    return is_hit


def _unsettled(
    fault: Fault, away: dict[str, NDArray[np.float64]], stamps: NDArray[np.int64]
) -> float:
    """Return how far a disturbed joint is from its path when it should have settled."""
    if fault.back_ns is None:
        return 0.0
    settled = int(np.searchsorted(stamps, fault.back_ns + round(SETTLE * _NS)))
    return float(away[fault.joint][settled]) if settled < len(stamps) else 0.0


def _takeover(fault: Fault, series: JointSeries, damping: float) -> float:
    """Return the first effort of a restarted controller beyond its damping, in [N m]."""
    if fault.silent_ns is None or fault.kind == "freeze":
        return 0.0
    index = int(np.searchsorted(series.command_stamps_ns, fault.silent_ns))
    if index == len(series.effort):
        return 0.0
    at = int(np.searchsorted(series.state_stamps_ns, series.command_stamps_ns[index]))
    lately = slice(max(0, at - _LATELY), at + 1)
    seconds = np.ptp(series.state_stamps_ns[lately]) / _NS
    speed = np.ptp(series.position[lately]) / seconds if seconds else 0.0
    return max(0.0, float(abs(series.effort[index]) - 2.0 * damping * speed))
