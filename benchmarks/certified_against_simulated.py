"""Random loops: is every degree that the tool certifies stable in simulation?

    python benchmarks/certified_against_simulated.py --loops 520 --seed 1 --processes 2

For every loop the certified interval is computed, checked again at its ends and simulated there,
at a degree inside, and at a degree drawn without looking at it. A simulation follows the ideal
loop in the time in which it is homogeneous of degree zero, so that a degree of either sign grows
or shrinks like an exponential, from several points of a sphere; it is unstable when one of them
does not shrink. Ends with exit code 1 if anything certified is unstable.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hpid_ros.base.errors import GainError, NormError
from hpid_ros.control import CanonicalNorm, Gains, WeightedNorm
from hpid_ros.control.norms import Norm
from hpid_ros.control.settings import NormSettings
from hpid_ros.stability.certificate_search import certified_degree_interval
from hpid_ros.stability.certification import best_spans
from hpid_ros.stability.gain_check import integral_ratio

STARTS = 4
HORIZONS = (250.0, 3000.0)  # in units of 1 / ki^(1/3); the second where the first decides nothing
SHRUNK, GROWN = 1e-5, 1e5  # of the size below, which a stable loop may raise a hundredfold first
LARGEST_DEGREE = 0.495
TOLERANCE = 2e-2  # of the intervals: coarser than the tool's own, for the sake of time


State = NDArray[np.float64]
"""Integral of the error, error and error rate; in units of the loop's own time."""

NormOfDegree = Callable[[float], Norm]


class _End:
    """An event of ``solve_ivp`` that ends it: the state's size passes a value."""

    terminal = True

    def __init__(self, size: Callable[[State], float], value: float) -> None:
        self._size, self._log = size, math.log(value)

    def __call__(self, _: float, x: State) -> float:
        return math.log(self._size(x)) - self._log


class SimulatedLoop:
    """The ideal loop in its own time unit 1 / ki^(1/3), by the scalar norm of the law itself."""

    def __init__(self, gains: Gains, norm: Norm) -> None:
        self.unit = gains.i ** (1.0 / 3.0)
        self.a, self.b = gains.p / self.unit**2, gains.d / self.unit
        self.norm, self.degree = norm, norm.degree
        self.scale = (norm(1.0, 0.0) * norm(0.0, self.unit)) ** 0.5  # the norm at size 1, about

    def size(self, x: State) -> float:
        """Return a homogeneous norm of the state."""
        mu = self.degree
        return float(abs(x[0]) ** (1.0 / (1.0 - mu)) + abs(x[1]) + abs(x[2]) ** (1.0 / (1.0 + mu)))

    def field(self, _: float, x: State) -> tuple[float, float, float]:
        """Return the derivative in the time dt size^mu, of degree zero."""
        n = self.norm(x[0], self.unit * x[1])
        multiplier = n**self.degree if n > 0.0 else 0.0
        pace = (self.scale * self.size(x)) ** -self.degree
        acceleration = x[2] - self.a * multiplier**2 * x[0] - self.b * multiplier * x[1]
        return pace * x[1], pace * acceleration, -pace * multiplier**3 * x[0]

    def is_stable_from(self, start: State) -> bool:
        """Tell whether the state shrinks for good from one point."""
        ends = (_End(self.size, SHRUNK), _End(self.size, GROWN))
        for horizon in HORIZONS:
            solution = solve_ivp(
                self.field, (0.0, horizon), start, "LSODA", rtol=1e-7, atol=1e-13,
                events=ends,
            )  # fmt: skip
            if solution.status == 1:
                return len(solution.t_events[0]) > 0
        sizes = np.array([self.size(x) for x in solution.y.T])
        third = solution.t[-1] / 3.0
        early = sizes[(solution.t > third) & (solution.t < 2.0 * third)].max()
        late = sizes[solution.t >= 2.0 * third].max()
        return bool(solution.status == 0 and late < early)

    def is_stable(self, random: np.random.Generator) -> bool:
        """Tell whether the state shrinks from every one of some points on a sphere."""
        for _ in range(STARTS):
            direction = random.normal(size=3)
            start = direction / np.linalg.norm(direction)
            if not self.is_stable_from(start):
                return False
        return True


def random_loop(
    random: np.random.Generator, *, is_in_effort: bool
) -> tuple[Gains, str, NormOfDegree]:
    """Return gains, the kind of norm, and the norm of every degree."""
    gain_p = float(10.0 ** random.uniform(-0.5, 2.5))
    damping = float(10.0 ** random.uniform(-0.7, 0.7))
    gain_d = 2.0 * damping * math.sqrt(gain_p)
    gains = Gains(gain_p, random.uniform(0.02, 0.95) * gain_p * gain_d, gain_d)
    if is_in_effort:
        scale = float(10.0 ** random.uniform(-1.5, 1.5))
        kind = "weighted" if random.random() < 0.5 else "canonical"
        return gains, kind, NormSettings(type=kind, effort_scale=scale).family(gains.p, gains.d)
    # The error at rest and the rate at which the norm is 1; the rate is that of the loop's own
    # oscillation about such an error, within an order and a half.
    error = float(10.0 ** random.uniform(-1.5, 1.5))
    rate = error * math.sqrt(gain_p) * float(10.0 ** random.uniform(-1.5, 1.5))
    if random.random() < 0.5:
        return gains, "weighted", lambda degree: WeightedNorm.scaled(degree, error, 1.0 / rate)
    cross = random.uniform(-0.8, 0.8) / (error * rate)
    shape = [[error**-2, cross], [cross, rate**-2]]
    return gains, "canonical", lambda degree: CanonicalNorm(degree, shape)


def try_loop(seed: int, *, is_in_effort: bool = False) -> dict[str, Any]:
    """Return what one loop gave."""
    random = np.random.default_rng(seed)
    gains, kind, norm_of_degree = random_loop(random, is_in_effort=is_in_effort)
    drawn = random.uniform(-LARGEST_DEGREE, LARGEST_DEGREE)
    result: dict[str, Any] = {"seed": seed, "norm": kind, "rho": integral_ratio(gains)}
    started = time.process_time()
    try:
        interval = certified_degree_interval(gains, norm_of_degree, tolerance=TOLERANCE)
    except GainError as error:
        return result | {"refused": str(error), "degrees": [], "disputed": 0}
    result |= {"lower": interval.lower, "upper": interval.upper}
    result["seconds"] = time.process_time() - started
    inside = random.uniform(interval.lower, interval.upper)
    degrees, disputed = [], 0
    for degree in sorted({interval.lower, inside, interval.upper, drawn}):
        try:
            norm = norm_of_degree(degree)
        except NormError:  # a canonical norm's P is not monotone there: there is no such law
            continue
        is_certified = interval.contains(degree)
        if is_certified:
            try:
                best_spans(interval, norm)
            except GainError:
                disputed += 1
        is_stable = SimulatedLoop(gains, norm).is_stable(random)
        degrees.append([degree, is_certified, is_stable])
    return result | {"degrees": degrees, "disputed": disputed}


def main() -> int:
    """Run and print the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--loops", type=int, default=520)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--effort-scale", action="store_true", help="norms of norm.effort_scale alone"
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="a JSON line for each loop")
    arguments = parser.parse_args()
    seeds = [1_000_000 * arguments.seed + k for k in range(arguments.loops)]
    results = []
    lines = arguments.output.open("w") if arguments.output else nullcontext()
    with lines as output, Pool(arguments.processes) as pool:
        attempt = partial(try_loop, is_in_effort=arguments.effort_scale)
        for done, result in enumerate(pool.imap_unordered(attempt, seeds), 1):
            results.append(result)
            if output:
                print(json.dumps(result), file=output, flush=True)
            if done % 20 == 0:
                print(f"{done} of {len(seeds)} loops", file=sys.stderr, flush=True)
    return report(results)


def report(results: Sequence[dict[str, Any]]) -> int:
    """Print the counts and return the exit code."""
    tried = [(r, *each) for r in results for each in r["degrees"]]
    wrong = [t for t in tried if t[2] and not t[3]]
    seconds = [r["seconds"] for r in results if "seconds" in r]
    kinds = {kind: sum(r["norm"] == kind for r in results) for kind in ("weighted", "canonical")}
    print(f"loops                        {len(results)} {kinds}")
    print(f"refused                      {sum('refused' in r for r in results)}")
    print(f"degrees simulated            {len(tried)}, from {STARTS} points each")
    print(f"certified and stable         {sum(t[2] and t[3] for t in tried)}")
    print(f"certified and unstable       {len(wrong)}")
    print(f"certified, check disputes it {sum(r['disputed'] for r in results)}")
    print(f"not certified, stable        {sum(not t[2] and t[3] for t in tried)}")
    print(f"not certified, unstable      {sum(not t[2] and not t[3] for t in tried)}")
    for low, high in ((0.0, 0.3), (0.3, 0.6), (0.6, 0.95)):
        widths = [
            r["upper"] - r["lower"] for r in results if "upper" in r and low <= r["rho"] < high
        ]
        if widths:
            print(
                f"rho {low} to {high}: median width {np.median(widths):.3f} of {len(widths)} loops"
            )
    print(f"CPU time of an interval      median {np.median(seconds):.2f} s, "
          f"largest {max(seconds):.2f} s")  # fmt: skip
    for result, degree, *_ in wrong:
        print(f"WRONG: seed {result['seed']} degree {degree}")
    return 1 if wrong or any(r["disputed"] for r in results) else 0


if __name__ == "__main__":
    sys.exit(main())
