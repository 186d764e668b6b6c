"""How the ideal loop converges: in finite time, exponentially, nearly in fixed time.

A certificate's norm V falls strictly, so the instants at which it passes the powers of ten are
well defined, and the time of each decade tells the class.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hpid_ros.control import CanonicalNorm, Gains, WeightedNorm
from hpid_ros.stability.certificate_search import certify_degree
from hpid_ros.stability.certification import best_spans
from hpid_ros.stability.closed_loop import closed_loop_field, dilated, state_norm
from hpid_ros.stability.gain_check import decay_time

pytestmark = pytest.mark.slow

GAINS = Gains(p=3.0, i=1.0, d=3.0)
DIRECTIONS = ((0.3, -1.0, 0.5), (0.0, 0.0, 1.0))


def transients(degree):
    """Give a test both norms, each from a direction of its own."""
    norms = WeightedNorm(degree, 1.0, 1.0), CanonicalNorm(degree, ((1.0, 0.2), (0.2, 1.0)))
    cases = zip(norms, DIRECTIONS, strict=True)
    return pytest.mark.parametrize(("norm", "direction"), cases, ids=["weighted", "canonical"])


class Transient:
    """The instants at which V passes given levels, from one point of the level's sphere."""

    def __init__(self, norm):
        self.norm = norm
        self.certificate = certify_degree(GAINS, norm)
        self.shape = self.certificate.spans[0].shape
        ((_, margins),) = best_spans(self.certificate, norm)
        self.decay = margins.decay

    def times(self, direction, start, levels):
        degree = self.norm.degree
        size = state_norm(self.shape, degree, direction)
        state = dilated(degree, direction, np.log(start / size))

        def passed(_, x):
            return math.log(float(state_norm(self.shape, degree, x)) / levels[-1])

        passed.terminal = True
        solution = solve_ivp(
            lambda _, x: closed_loop_field(GAINS, self.norm, x),
            (0.0, 1e6),
            state,
            "LSODA",
            rtol=1e-7,
            atol=1e-16,
            events=passed,
        )
        assert solution.status == 1
        sizes = state_norm(self.shape, degree, solution.y.T)
        assert np.all(np.diff(sizes) < 1e-4 * sizes[:-1])  # what the integration leaves
        return np.interp(-np.log(levels), -np.log(np.minimum.accumulate(sizes)), solution.t)


@transients(-0.3)
def test_negative_degrees_settle_in_finite_time(norm, direction):
    transient = Transient(norm)
    levels = 10.0 ** -np.arange(1.0, 8.0)
    times = transient.times(direction, 1.0, levels)
    gaps = np.diff(times)
    # Each decade takes 10^mu of the one before, so that there is a last instant.
    assert gaps[3:] / gaps[:-3] == pytest.approx(10.0 ** (3 * norm.degree), rel=0.6)
    assert times[-1] <= decay_time(norm.degree, transient.decay, 1.0, 0.0)
    last = times[-1] + gaps[-1] / (10.0**-norm.degree - 1.0)
    assert last - times[2] < 2.0 * (times[3] - times[2]) / (1.0 - 10.0**norm.degree)


@transients(0.0)
def test_degree_zero_settles_exponentially(norm, direction):
    transient = Transient(norm)
    times = transient.times(direction, 1.0, 10.0 ** -np.arange(1.0, 8.0))
    gaps = np.diff(times)
    assert gaps[2:] == pytest.approx(gaps[-1], rel=0.2)
    assert gaps.max() <= math.log(10.0) / transient.decay


@transients(0.3)
def test_positive_degrees_come_close_in_a_time_that_no_start_exceeds(norm, direction):
    transient = Transient(norm)
    starts = 10.0 ** np.arange(0.5, 6.5)
    times = np.array([transient.times(direction, start, [1.0])[0] for start in starts])
    assert times.max() <= decay_time(norm.degree, transient.decay, math.inf, 1.0)
    # What a thousandfold start adds shrinks with its size; for a PID it would be constant.
    added = times[3:] - times[:-3]
    assert np.all(added[1:] < 0.75 * added[:-1])
    assert times[-1] < 1.1 * times[-2]
