"""The closed loop on the graph against the transport's floor and against plain rclpy.

MuJoCo simulates the robot, one step in a period, where the name of a figure says nothing else.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.ours_graph import run_checked, run_ours, timing_of
from benchmarks.processes import Scripts
from benchmarks.tracking import tracking
from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.graph_run import PROCESSES, GraphOptions
from hpid_bench.experiment.in_process import NoProgress
from hpid_bench.experiment.processes import closed_environment, own_domain
from hpid_ros.base.errors import RunError
from hpid_ros.simulation.settings import installed_engines

LABEL = "hPID"
ENGINE = "mujoco"

_SECONDS = {"each": 4.0, "composed": 9.0, "single": 9.0}  # of simulated time
_SECONDS_QUICK = {"each": 2.0, "composed": 4.0, "single": 6.0}
_CYCLES, _CYCLES_QUICK = {"each": 4000, "composed": 10_000, "single": 20_000}, 500
_CLOCK, _STEAL = 100.0, 8  # ticks in a second, and their place in the first line of /proc/stat


def groups(quick: bool) -> tuple[Group, ...]:
    """Return the figures of the closed loop."""
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


_FLOOR_WITHIN, _NAIVE_WITHIN = 120.0, 300.0  # [s] for a whole run
_ASKER = "asker"


def run_floor(
    joints: Sequence[str],
    processes: str,
    cycles: int,
    is_timing: bool = False,
    has_physics: bool = False,
) -> Mapping[str, float]:
    """Run the echo graph once.

    Returns:
        ``rate`` in cycles per second; ``latency``, the median from a state's publication to the
        arrival of an answer, in [us], when asked for; ``repeats``, how often it began anew
        because a message was lost.
    """
    ask = ["--ask", *joints, "--cycles", str(cycles), *(["--latency"] if is_timing else [])]
    ask += ["--physics"] if has_physics else []
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder,
        own_domain() as domain,
        Scripts(closed_environment(domain), Path(folder), is_batch=True) as scripts,
    ):
        for name, arguments in _echoes(joints, processes).items():
            scripts.start(name, "floor", arguments)
        together = ["--echo", *joints] if processes == "single" else []
        scripts.start(_ASKER, "floor", [*ask, *together])
        result = scripts.result(_ASKER, _FLOOR_WITHIN)
    if result["cycles"] != cycles:
        raise RunError(f"the echo graph counted {result['cycles']} cycles of {cycles}")
    return {name: float(value) for name, value in result.items()}


def _echoes(joints: Sequence[str], processes: str) -> dict[str, list[str]]:
    """Return the arguments of the processes that hold nothing but echo nodes."""
    if processes == "each":
        return {f"echo_{joint}": ["--echo", joint] for joint in joints}
    if processes == "composed":
        return {"echoes": ["--echo", *joints]}
    if processes == "single":
        return {}
    raise ValueError(f"processes must be one of {', '.join(PROCESSES)}, not {processes!r}")


_LARGEST_ERROR = 0.1  # [rad] at the end of a run; without control a joint is 0.3 rad away
_SETTLED_AFTER = 1.0  # [s], from when on the error is looked at
_ROBOT = "robot"


def run_naive(seconds: float) -> Mapping[str, float]:
    """Run the naive closed loop once, one physics step in each control period.

    Returns:
        ``rate`` in states per second.
    """
    experiment = tracking()
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder,
        own_domain() as domain,
        Scripts(closed_environment(domain), Path(folder)) as scripts,
    ):
        for joint in experiment.world.joints:
            scripts.start(joint, "naive", ["--control", joint])
        scripts.start(_ROBOT, "naive", ["--simulate", "--seconds", str(seconds)])
        result = scripts.result(_ROBOT, _NAIVE_WITHIN)
    expected = round(seconds * 1e9 / experiment.world.control_period_ns) + 1
    if result["states"] != expected:
        raise RunError(f"the naive loop had {result['states']} states, not {expected}")
    if seconds >= _SETTLED_AFTER and result["largest_error"] > _LARGEST_ERROR:
        raise RunError(f"the naive loop does not control: {result['largest_error']:.3f} rad away")
    return {"rate": float(result["rate"])}
