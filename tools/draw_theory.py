"""Draws the figures of theory.md into docs/figures and prints the numbers that it quotes.

python tools/draw_theory.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from certified_against_simulated import SimulatedLoop  # noqa: E402

from hpid_bench.report.figures import RUN_STYLES  # noqa: E402
from hpid_bench.report.plots import figure_style  # noqa: E402
from hpid_ros.control import Gains, WeightedNorm  # noqa: E402
from hpid_ros.control.settings import NormSettings  # noqa: E402
from hpid_ros.stability.certificate_search import certified_degree_interval  # noqa: E402
from hpid_ros.stability.closed_loop import closed_loop_field  # noqa: E402

FIGURES = ROOT / "docs" / "figures"
STIFFNESS, DAMPING = 5.0, 2.0  # kp [1/s^2] and kd [1/s] of the family, on a unit inertia
RATIOS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95)
DAMPINGS = (0.5, 2.0, 7.2)  # kd^2/(kp m)
LIMIT = 0.495
TRANSIENT_GAINS = Gains(p=3.0, i=1.0, d=3.0)  # three poles at -1/s
DEGREES = (0.0, -0.3, 0.3)
POINTS = 8  # of a transient, in each step of the solver
NAMES = {0.0: "PID", -0.3: "hPID, mu = -0.3", 0.3: "hPID, mu = +0.3"}


def norm_of_degree(degree):
    """Return the norm of the family of gains."""
    return WeightedNorm(degree, 1.0, 3.0)


def ends(gains, norm):
    """Return the ends of the certified and of the simulated range of the degree."""
    simulated = (simulated_end(gains, norm, direction) for direction in (-1.0, 1.0))
    certificate = certified_degree_interval(gains, norm)
    return (certificate.lower, certificate.upper, *simulated)


def simulated_end(gains, norm, direction):
    """Return the outermost degree up to which every simulation is stable, to 0.005."""

    def is_stable(degree):
        loop = SimulatedLoop(gains, norm(direction * degree))
        return loop.is_stable(np.random.default_rng(1))

    low, high = 0.0, LIMIT
    for degree in np.arange(0.045, LIMIT + 1e-9, 0.045):
        if not is_stable(degree):
            high = degree
            break
        low = degree
    while low < LIMIT and high - low > 0.005:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return direction * min(low, LIMIT)


def draw_ranges():
    """Draw certified against simulated ranges over rho."""
    rows = []
    for ratio in RATIOS:
        gains = Gains(STIFFNESS, ratio * STIFFNESS * DAMPING, DAMPING)
        rows.append((ratio, *ends(gains, norm_of_degree)))
        print(
            "rho {:.2f}: certified ({:+.3f}, {:+.3f}), simulated ({:+.3f}, {:+.3f})".format(
                *rows[-1]
            )
        )
    ratio, lower, upper, least, largest = np.array(rows).T
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.fill_between(ratio, least, largest, color="#dbe4ee")
    axes.fill_between(ratio, lower, upper, color=RUN_STYLES[0].color, alpha=0.8, linewidth=0)
    axes.axhline(0.0, color="white", linewidth=0.8)
    for x, y, text, color in (
        (0.2, 0.15, "certified", "white"),
        (0.62, 0.38, "stable in simulation, not certified", "#20242b"),
        (0.87, -0.44, "unstable", "#20242b"),
    ):
        axes.text(x, y, text, color=color, fontsize=10)
    axes.set(xlabel="rho = ki / (kp kd)", ylabel="degree mu", ylim=(-0.5, 0.5))
    axes.set_title("Degrees at which kp = 5, kd = 2 is stable, weighted norm (1, 3)")
    return figure


def transient(degree, start, duration, end):
    """Return times and sizes max(|e|, |de/dt|) of the ideal loop, until all is below the end.

    Each step of the solver is divided, so that straight lines between the points will do.
    """
    norm = WeightedNorm(degree, 1.0, 1.0)

    def arrived(_, x):
        return np.log(np.abs(x).max() / end)

    arrived.terminal = True
    solution = solve_ivp(
        lambda _, x: closed_loop_field(TRANSIENT_GAINS, norm, x),
        (0.0, duration),
        (start, 0.0, 0.0),
        "LSODA",
        rtol=1e-8,
        atol=1e-3 * end,
        events=arrived,
        dense_output=True,
    )
    steps = np.arange(solution.t.size)
    times = np.interp(np.linspace(0.0, steps[-1], POINTS * steps[-1] + 1), steps, solution.t)
    return times, np.abs(solution.sol(times)[:2]).max(axis=0)


def last_above(times, sizes, level):
    """Return when the size stays below a level for good, between points by its logarithm."""
    above = np.flatnonzero(sizes > level)
    if not above.size:
        return 0.0
    last = above[-1]
    if last + 1 == sizes.size:
        return np.inf
    logs = np.log(sizes[last : last + 2] / level)
    return times[last] + (times[last + 1] - times[last]) * logs[0] / (logs[0] - logs[1])


def draw_classes():
    """Draw the three classes of convergence: down to nothing, and down from afar."""
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    near, far = figure.subplots(1, 2)
    starts = 10.0 ** np.arange(1.0, 6.1, 0.5)
    for degree, style in zip(DEGREES, RUN_STYLES, strict=False):
        look = {"color": style.color, "linewidth": 1.6, "label": NAMES[degree]}
        look["dashes"] = style.dashes or (None, None)
        times, sizes = transient(degree, 1.0, 30.0, 1e-12)
        near.semilogy(times, sizes, **look)
        settled = [last_above(times, sizes, 10.0**-k) for k in (2, 4, 6, 8)]
        arrivals = []
        for start in starts:
            arrivals.append(last_above(*transient(degree, start, 1e4, 0.1), 1.0))
        far.loglog(starts, arrivals, marker="o", markersize=3, **look)
        print(f"{NAMES[degree]:16} below 1e-2, 1e-4, 1e-6, 1e-8 after "
              + ", ".join(f"{t:.2f}" for t in settled) + " s; from 1e1, 1e3, 1e6 within 1 after "
              + ", ".join(f"{arrivals[k]:.2f}" for k in (0, 4, 10)) + " s")  # fmt: skip
    near.set(xlabel="time [s]", ylim=(1e-10, 3.0), xlim=(0.0, 30.0))
    near.set_ylabel("max(|e| [rad], |de/dt| [rad/s])")
    near.set_title("From 1 rad: finite time, exponential, slower")
    far.set(xlabel="first error [rad]", ylabel="time until all is within 1 [s]")
    far.set_title("From afar: mu > 0 hardly depends on the start")
    far.legend(loc="upper left")
    return figure


def print_groups():
    """Print certified against simulated ranges over both groups of a loop in units of effort."""
    for damping in DAMPINGS:
        for ratio in (0.125, 0.4, 0.863):
            gains = Gains(1.0, ratio * damping**0.5, damping**0.5)
            norm = NormSettings(type="canonical", effort_scale=1.0).family(gains.p, gains.d)
            found = "({:+.3f}, {:+.3f}), simulated ({:+.3f}, {:+.3f})".format(*ends(gains, norm))
            print(f"kd^2/(kp m) {damping}, rho {ratio}: certified {found}")


def main():
    """Draw everything."""
    FIGURES.mkdir(exist_ok=True)
    with figure_style():
        mpl.rcParams["legend.frameon"] = False
        for name, draw in (("classes", draw_classes), ("degree_ranges", draw_ranges)):
            figure = draw()
            figure.savefig(FIGURES / f"{name}.png", dpi=150)
    print_groups()


if __name__ == "__main__":
    main()
