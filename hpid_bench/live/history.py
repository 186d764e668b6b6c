"""What a joint did lately: samples, what is drawn of them, indices over a moving window."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from hpid_bench.live.known_controllers import Samples
from hpid_ros.base.errors import HpidError
from hpid_ros.base.units import Numbers
from hpid_ros.control.assembly import make_law, make_norm
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.settings import LoopSettings

LONGEST_HISTORY = 60.0
"""Samples of so many seconds are kept."""

MOST_HISTORY_SAMPLES = 200_000
_REFERENCES_APART, _STATES_APART = 2.0, 0.5  # [s], at most
_EFFORTS_OVER = 0.5  # [s]
_LATELY = 0.5  # [s]


class Track:
    """The newest rows of a signal, oldest first."""

    def __init__(self, columns: int) -> None:
        self._rows = np.empty((1024, columns))
        self._first = self._end = 0
        self._drawn_until = -math.inf

    @property
    def rows(self) -> Numbers:
        """All rows, shape (N, columns); a view that is valid until the next change."""
        return self._rows[self._first : self._end]

    def clear(self) -> None:
        self._first = self._end = 0
        self._drawn_until = -math.inf

    def append(self, rows: Numbers) -> None:
        """Append rows, and forget those that are too old or too many."""
        rows = rows[-MOST_HISTORY_SAMPLES:]
        if not len(rows):
            return
        if self._end + len(rows) > len(self._rows):
            self._make_room(len(rows))
        self._rows[self._end : self._end + len(rows)] = rows
        self._end += len(rows)
        times = self._rows[self._first : self._end, 0]
        self._first += int(np.searchsorted(times, times[-1] - LONGEST_HISTORY))
        self._first = max(self._first, self._end - MOST_HISTORY_SAMPLES)

    def _make_room(self, count: int) -> None:
        kept = self.rows.copy()
        if 2 * (len(kept) + count) > len(self._rows):
            self._rows = np.empty((4 * (len(kept) + count), self._rows.shape[1]))
        self._rows[: len(kept)] = kept
        self._first, self._end = 0, len(kept)

    def since(self, time: float) -> Numbers:
        rows = self.rows
        return rows[int(np.searchsorted(rows[:, 0], time, side="right")) :]

    def fresh(self) -> Numbers:
        """Return the rows that came since the last call."""
        rows = self.since(self._drawn_until)
        if len(rows):
            self._drawn_until = float(rows[-1, 0])
        return rows

    def within(self, begin: float, end: float) -> Numbers:
        """Return the rows from one time to another, both included."""
        rows = self.rows
        first, last = np.searchsorted(rows[:, 0], [begin, np.nextafter(end, math.inf)])
        return rows[first:last]

    def latest(self, over: float) -> Numbers:
        rows = self.rows
        return self.within(rows[-1, 0] - over, rows[-1, 0]) if len(rows) else rows


class WindowIndices(NamedTuple):
    """Indices over the last seconds, so that windows of any length compare; "rad" may read "m"."""

    itae_rate: float  # [rad]
    ivc_rate: float  # [N m/s] variation of the effort per second
    effort: float  # [N m] root mean square of the effort
    error: float  # [rad] largest absolute error


_NO_INDICES = WindowIndices(*(math.nan,) * 4)


class JointHistory:
    """Samples of one joint.

    The error is the reference less the position, at every state. ``~/reference`` is told less
    often than there are states: in between it is taken to be straight, so that errors are known
    up to the newest reference.
    """

    def __init__(self, settings: LoopSettings) -> None:
        self._tune(settings)
        self._states, self._efforts, self._references = Track(3), Track(2), Track(3)
        self._errors, self._norms = Track(2), Track(3)

    def retune(self, settings: LoopSettings) -> None:
        if settings != self._settings:
            self._tune(settings)

    def _tune(self, settings: LoopSettings) -> None:
        self._settings = settings
        self._limits: tuple[float, float] | None = None
        with suppress(HpidError):  # of decoupling, whose inertia the controller's model may have
            self._norm, law = make_norm(settings), make_law(settings)
            if isinstance(law, HomogeneousPid):
                self._limits = law.norm_floor, law.norm_cap

    @property
    def now(self) -> float:
        """Time of the newest state in [s]; -inf before the first."""
        rows = self._states.rows
        return float(rows[-1, 0]) if len(rows) else -math.inf

    @property
    def position(self) -> float | None:
        """Of the newest state in [rad] or [m]; None before the first."""
        rows = self._states.rows
        return float(rows[-1, 1]) if len(rows) else None

    @property
    def reference(self) -> float | None:
        """The newest, in [rad] or [m]; None before the first."""
        rows = self._references.rows
        return float(rows[-1, 1]) if len(rows) else None

    @property
    def is_saturated(self) -> bool:
        """Whether the effort has been at a limit for a while."""
        efforts = self._efforts.latest(_LATELY)
        limits = self._settings.effort
        at_limit = (efforts[:, 1] >= limits.u_clamp_max) | (efforts[:, 1] <= limits.u_clamp_min)
        return len(efforts) > 1 and self._is_new(efforts) and bool(np.all(at_limit))

    @property
    def distance(self) -> float:
        """How far it has been from its reference for a while, in [rad] or [m]; nan if unknown."""
        errors = self._errors.latest(_LATELY)
        if len(errors) < 2 or not self._is_new(errors):
            return math.nan
        return float(np.min(np.abs(errors[:, 1])))

    def _is_new(self, rows: Numbers) -> bool:
        return bool(rows[-1, 0] > self.now - 2.0 * _LATELY)

    @property
    def state(self) -> tuple[float | None, float | None]:
        """Its position, and the mean effort of the last half second in [N m] or [N]."""
        rows = self._efforts.rows
        if not len(rows):
            return self.position, None
        lately = self._efforts.since(rows[-1, 0] - _EFFORTS_OVER)
        return self.position, float(np.mean(lately[:, 1]))

    def append(self, samples: Samples) -> None:
        """Take what came since the last time; what is not finite is left out."""
        if samples.is_restarted:
            tracks = (self._states, self._efforts, self._references, self._errors, self._norms)
            for track in tracks:
                track.clear()
        states = samples.states[np.isfinite(samples.states[:, :2]).all(axis=1)]
        self._states.append(states)
        self._efforts.append(samples.efforts[np.isfinite(samples.efforts).all(axis=1)])
        references = samples.references[np.isfinite(samples.references).all(axis=1)]
        self._references.append(references)
        self._append_errors(references)

    def _append_errors(self, references: Numbers) -> None:
        """Compute what the newest references tell: errors, norms and multipliers."""
        if not len(references):
            return
        done, end = self._errors.rows, float(references[-1, 0])
        begin = np.nextafter(done[-1, 0], math.inf) if len(done) else references[0, 0]
        fresh = self._states.within(float(begin), end)
        if len(fresh):
            known = self._references.within(fresh[0, 0] - _REFERENCES_APART, end)
            if not len(known):  # what was told before the clock went back may come late
                return
            there = np.interp(fresh[:, 0], known[:, 0], known[:, 1])
            self._errors.append(np.column_stack([fresh[:, 0], self._off(there - fresh[:, 1])]))
        times = references[:, 0]
        states = self._states.within(times[0] - _STATES_APART, end + _STATES_APART)
        if len(states) > 1:
            at = np.interp(times, states[:, 0], states[:, 1])
            rate = references[:, 2] - self._velocity(times, states)
            rows = np.column_stack([times, self._off(references[:, 1] - at), rate])
            self._norms.append(self._norm_rows(rows))

    def _norm_rows(self, errors: Numbers) -> Numbers:
        """Return time, norm and multiplier of rows of time, error and rate; nan without a norm."""
        if self._limits is None:
            return np.column_stack([errors[:, 0], *(np.full(len(errors), np.nan),) * 2])
        found = np.array([self._norm_of(error, rate) for _, error, rate in errors.tolist()])
        held = np.clip(found, *self._limits)
        with np.errstate(divide="ignore"):
            return np.column_stack([errors[:, 0], found, held**self._settings.degree])

    def _norm_of(self, error: float, rate: float) -> float:
        try:
            return self._norm(error, rate)
        except ArithmeticError:  # of what no joint does, but a message may say
            return math.inf

    def _velocity(self, times: Numbers, states: Numbers) -> Numbers:
        """Return velocities at times: measured, or differences over what the filter remembers."""
        if np.isfinite(states[-1, 2]):
            return np.asarray(np.interp(times, states[:, 0], np.nan_to_num(states[:, 2])))
        lag = max(2.0 * self._settings.velocity.velocity_filter_time_constant, 1e-3)
        ends = [np.interp(t, states[:, 0], states[:, 1]) for t in (times - lag, times)]
        return np.asarray((ends[1] - ends[0]) / lag)

    def _off(self, differences: Numbers) -> Numbers:
        """Return errors; of an encoder that starts again, those the shorter way round."""
        wrap = self._settings.encoder.encoder_wrap
        if wrap <= 0.0:
            return differences
        return np.asarray(differences - wrap * np.rint(differences / wrap))

    def drawn(self) -> dict[str, list[float]]:
        """Return what is new to draw since the last call: of each signal times and values in turn.

        Of many samples the least and the largest are drawn, so that no peak is lost.
        """
        norms = self._norms.fresh()
        rows = {
            "position": self._states.fresh(),
            "reference": self._references.fresh(),
            "error": self._errors.fresh(),
            "effort": self._efforts.fresh(),
            "norm": norms,
            "multiplier": norms[:, [0, 2]],
        }
        return {name: extremes(each[:, 0], each[:, 1]) for name, each in rows.items()}

    def indices(self, over: float) -> WindowIndices:
        """Return indices over the last seconds; nan where there are no samples."""
        errors, efforts = self._errors.latest(over), self._efforts.latest(over)
        if len(errors) < 2 or len(efforts) < 2:
            return _NO_INDICES
        times, sizes = errors[:, 0] - errors[0, 0], np.abs(errors[:, 1])
        length, acting = float(times[-1]), float(efforts[-1, 0] - efforts[0, 0])
        if not (length > 0.0 and acting > 0.0):
            return _NO_INDICES
        return WindowIndices(
            _integral(times, times * sizes) / (0.5 * length**2),
            float(np.sum(np.abs(np.diff(efforts[:, 1])))) / acting,
            math.sqrt(_integral(efforts[:, 0], efforts[:, 1] ** 2) / acting),
            float(np.max(sizes)),
        )


def _integral(times: Numbers, values: Numbers) -> float:
    """Return the trapezoidal rule's; many times a second, so not rounded as for a table."""
    return float(np.sum(0.5 * np.diff(times) * (values[1:] + values[:-1])))


def extremes(times: Numbers, values: Numbers, most: int = 4) -> list[float]:
    """Return times and values in turn of few samples, the least and the largest among them."""
    is_usable = np.isfinite(values)
    times, values = times[is_usable], values[is_usable]
    if len(times) > most:
        ends = {0, int(np.argmin(values)), int(np.argmax(values)), len(times) - 1}
        places = sorted(ends)
        times, values = times[places], values[places]
    return [float(each) for pair in zip(times, values, strict=True) for each in pair]


class RisingCount:
    """Whether a count that a controller tells has grown lately."""

    def __init__(self, within: float) -> None:
        self._within = within
        self._count: int | None = None
        self._grew_at = -math.inf

    def tell(self, count: int, now: float) -> bool:
        """Take the present count, and return whether it grew lately; a lower one starts again."""
        if self._count is not None and count > self._count:
            self._grew_at = now
        self._count = count
        return now <= self._grew_at + self._within
