"""The closed loop on the graph against the transport's floor and against plain rclpy.

MuJoCo simulates the robot, one step in a period, where the name of a figure says nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.floor_graph import run_floor
from benchmarks.naive_graph import run_naive
from benchmarks.ours_graph import run_checked, run_ours, timing_of
from benchmarks.tracking import tracking
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph_run import GraphOptions
from hpid_ros.experiment.in_process import NoProgress
from hpid_ros.simulation.settings import installed_engines

LABEL = "hPID"
ENGINE = "mujoco"

_SECONDS = {"each": 4.0, "composed": 9.0, "single": 9.0}  # of simulated time
_SECONDS_QUICK = {"each": 2.0, "composed": 4.0, "single": 6.0}
_CYCLES, _CYCLES_QUICK = {"each": 4000, "composed": 10_000, "single": 20_000}, 500
_CLOCK, _STEAL = 100.0, 8  # ticks in a second, and their place in the first line of /proc/stat


def groups(quick: bool) -> tuple[Group, ...]:
    """Return the figures of the closed loop.

    Args:
        quick: Whether shorter runs will do.
    """
    return (
        _in_processes(quick),
        _composed(quick, "composed", "loop.composed", (Bound("ratio", least=0.6),)),
        _composed(quick, "single", "loop.single_process", ()),
        _jitter(3.0 if quick else 60.0),
    )


def _in_processes(quick: bool) -> Group:
    seconds = (_SECONDS_QUICK if quick else _SECONDS)["each"]
    bare, recorded = GraphOptions("each", is_recorded=False), GraphOptions("each")
    contenders: dict[str, Measure] = {
        "floor": _floor("each", quick, is_timing=True),
        "ours": _ours(tracking(1, seconds, ENGINE), bare),
        "ours, 4 physics steps": _ours(tracking(4, seconds, ENGINE), bare),
        "ours, recorded": _ours(tracking(1, seconds, ENGINE), recorded),
        "floor and physics": _floor("each", quick, has_physics=True),
        "naive": lambda: run_naive(0.5 * seconds),
    }
    floor, rate = Source("floor", "rate"), "cycles/s"
    against = "echo floor, 9 processes"
    return Group(
        contenders,
        (
            Figure("loop.processes", rate, Source("ours", "rate"), floor, against,
                   (Bound("ratio", least=0.75),)),
            Figure("loop.processes.physics", rate, Source("ours", "rate"),
                   Source("floor and physics", "rate"), f"{against}, that steps the robot too",
                   (Bound("ratio", least=0.85),)),
            Figure("loop.processes.steps4", rate, Source("ours, 4 physics steps", "rate"), floor,
                   against),
            Figure("loop.recorded", rate, Source("ours, recorded", "rate"),
                   Source("ours", "rate"), "the same without a recorder",
                   (Bound("ratio", least=0.93),)),
            Figure("loop.naive", rate, Source("ours", "rate"), Source("naive", "rate"),
                   "plain rclpy, 9 processes", (Bound("ratio", least=4.0),)),
            Figure("latency.processes", "us", Source("ours", "latency"),
                   Source("floor", "latency"), against),
            *_with_bullet(contenders, seconds, floor, against),
        ),
    )  # fmt: skip


def _with_bullet(
    contenders: dict[str, Measure], seconds: float, floor: Source, against: str
) -> list[Figure]:
    """Add the closed loop with PyBullet, the default where it is installed, and its figures."""
    if "pybullet" not in installed_engines():
        return []
    figures = []
    for steps in (1, 4):
        name = f"ours, PyBullet, {steps} physics steps"
        experiment = tracking(steps, seconds, "pybullet")
        contenders[name] = _ours(experiment, GraphOptions("each", is_recorded=False))
        figures.append(
            Figure(f"loop.processes.pybullet.steps{steps}", "cycles/s", Source(name, "rate"),
                   floor, against)
        )  # fmt: skip
    return figures


def _composed(quick: bool, processes: str, name: str, bounds: tuple[Bound, ...]) -> Group:
    seconds = (_SECONDS_QUICK if quick else _SECONDS)[processes]
    options = GraphOptions(processes=processes, is_recorded=False)
    floor, ours = Source(f"floor, {processes}", "rate"), Source(f"ours, {processes}", "rate")
    loaded = Source(f"floor and physics, {processes}", "rate")
    form = "controllers composed" if processes == "composed" else "one process"
    against, rate = f"echo floor, {form}", "cycles/s"
    contenders: dict[str, Measure] = {
        floor.contender: _floor(processes, quick),
        loaded.contender: _floor(processes, quick, has_physics=True),
        ours.contender: _ours(tracking(1, seconds, ENGINE), options),
    }
    with_physics = f"{against}, that steps the robot too"
    return Group(
        contenders,
        (
            Figure(name, rate, ours, floor, against, bounds),
            Figure(
                f"{name}.physics", rate, ours, loaded, with_physics, (Bound("ratio", least=0.85),)
            ),
        ),
    )


def _jitter(seconds: float) -> Group:
    """Return the figure of the real-time mode: one long run, its own median the reference."""
    name = f"real time, {seconds:g} s"

    def measure() -> Mapping[str, float]:
        stolen = _stolen_time()
        options = GraphOptions("each", is_recorded=False, is_realtime=True)
        timing = timing_of(run_checked(tracking(1, seconds, ENGINE), LABEL, options, NoProgress()))
        worst = max(timing, key=lambda joint: joint["period"]["p99"])
        return {
            "p99": worst["period"]["p99"],
            "median": worst["period"]["median"],
            "largest [us]": max(joint["period"]["maximum"] for joint in timing),
            "states missed": float(sum(joint["missed"] for joint in timing)),
            "states of all joints": float(sum(joint["samples"] for joint in timing)),
            "stolen by the host [s]": _stolen_time() - stolen,
        }

    figure = Figure(
        "loop.jitter",
        "us",
        Source(name, "p99"),
        Source(name, "median"),
        "99th percentile of the period against its median, 1 kHz",
        (Bound("ratio", most=1.3),),
        ("largest [us]", "states missed", "states of all joints", "stolen by the host [s]"),
    )
    return Group({name: measure}, (figure,), rounds_at_most=1)


def _floor(
    processes: str, quick: bool, is_timing: bool = False, has_physics: bool = False
) -> Measure:
    cycles = _CYCLES_QUICK if quick else _CYCLES[processes]
    return lambda: run_floor(tracking().world.joints, processes, cycles, is_timing, has_physics)


def _ours(experiment: Experiment, options: GraphOptions) -> Measure:
    return lambda: run_ours(experiment, LABEL, options)


def _stolen_time() -> float:
    """Return the time that the host took from this machine's cores, in [s]."""
    return int(Path("/proc/stat").read_text().split()[_STEAL]) / _CLOCK
