r"""Velocity sources of a joint, and an observer of position, velocity and disturbance.

The joint is taken for a double integrator with a disturbance that changes slowly,

.. math:: \ddot q = a + w, \qquad \dot w = 0

with a the acceleration that the effort sent gives the joint's inertia, and w all the rest:
gravity, friction, other joints, a wrong inertia. This is the extended state observer: its state
is (q, dq/dt, w).
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from hpid_ros.base.errors import SettingError

_ROUNDING = 1e-3  # of a turn; a driver's pi need not be exactly half of it


class Unwrapper:
    """Adds up the increments of an encoder that wraps around.

    A step of more than half a turn between two states is a turn that the encoder has left out, if
    both positions lie within a turn of 0, as a wrapping encoder's do.
    """

    __slots__ = ("_before", "_has_wrapped", "_largest", "_offset", "_past", "_turn")

    def __init__(self, turn: float) -> None:
        self.set_turn(turn)
        self.reset()

    def set_turn(self, turn: float) -> None:
        """Go by another turn from the next position on; those before stay what they were."""
        self._turn = turn
        self._largest = turn * (1.0 + _ROUNDING)

    def reset(self) -> None:
        """Forget the past: the next position is taken as it is."""
        self._before = math.nan
        self._offset = 0.0
        self._has_wrapped = False

    def interrupt(self) -> None:
        """Note that the joint may have moved any way since the last position.

        Of an encoder that has wrapped before, the nearest turn is taken; of another one it is
        not known that it ever does.
        """
        if not self._has_wrapped:
            self._before = math.nan

    def continuous(self, position: float) -> float:
        """Return in [rad] what :meth:`update` would, and take no note of it."""
        offset = self._offset
        if self._wraps_at(position):
            offset -= self._turns_to(position)
        return position + offset

    def update(self, position: float) -> float:
        """Take a position, and return the continuous one in [rad]."""
        self._past = self._before, self._offset, self._has_wrapped
        if self._wraps_at(position):
            self._offset -= self._turns_to(position)
            self._has_wrapped = True
        self._before = position
        return position + self._offset

    def _wraps_at(self, position: float) -> bool:
        before = self._before
        is_far = abs(position - before) > 0.5 * self._turn
        return is_far and max(abs(position), abs(before)) < self._largest

    def _turns_to(self, position: float) -> float:
        """Return the whole turns from the last position to this one, in [rad]."""
        return self._turn * round((position - self._before) / self._turn)

    def undo(self) -> None:
        """Forget the last position: the joint was not there."""
        self._before, self._offset, self._has_wrapped = self._past


class VelocitySource(Protocol):
    """Gives one velocity a sample."""

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the velocity in [rad/s] at this sample."""

    def start_from(self, position: float, velocity: float) -> None:
        """Go on from where another source stands."""

    def reset(self) -> None:
        """Forget the past: the next sample is the first one."""


class _LastState:
    """The position and velocity after the last sample."""

    __slots__ = ("_position", "_velocity")

    _position: float | None
    _velocity: float

    def start_from(self, position: float, velocity: float) -> None:
        """Go on from a position in [rad] and a velocity in [rad/s]."""
        self._position, self._velocity = position, velocity

    def reset(self) -> None:
        """Forget the past: the next velocity is 0."""
        self._position = None
        self._velocity = 0.0


class FilteredVelocity(_LastState):
    """Backward difference behind a first-order low-pass filter.

    The filter is discretised by backward Euler, hence stable for every period:
    ``v += dt / (tau + dt) ((x - x_before) / dt - v)``.
    """

    __slots__ = ("time_constant",)

    def __init__(self, time_constant: float) -> None:
        if not math.isfinite(time_constant) or time_constant < 0.0:
            raise SettingError(
                f"the velocity filter's time constant must be finite and not negative, "
                f"not {time_constant} s"
            )
        self.time_constant = time_constant
        self.reset()

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the filtered difference in [rad/s]; the measured velocity is not used."""
        if self._position is not None and dt > 0.0:
            difference = (position - self._position) / dt
            self._velocity += dt / (self.time_constant + dt) * (difference - self._velocity)
        self._position = position
        return self._velocity


_FEW_ZEROS = 10  # a driver that is quantised, or asked at rest, tells as many


class MeasuredVelocity:
    """The robot's own velocity, or the filtered difference in samples that report none."""

    __slots__ = ("_fallback", "_zero_since", "_zeros", "is_reported", "moved_at_zero")

    def __init__(self, time_constant: float) -> None:
        self._fallback = FilteredVelocity(time_constant)
        self._zero_since, self._zeros = 0.0, 0
        self.moved_at_zero = 0.0
        self.is_reported = True

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the measured velocity in [rad/s], or an estimate where there is none."""
        estimate = self._fallback.update(position, velocity, dt)
        if velocity == 0.0:
            if not self._zeros or dt <= 0.0:
                self._zero_since, self._zeros = position, 0
            self._zeros += 1
            if self._zeros > _FEW_ZEROS:
                moved = abs(position - self._zero_since)
                self.moved_at_zero = max(moved, self.moved_at_zero)
        elif self._zeros:
            self._zeros, self.moved_at_zero = 0, 0.0
        self.is_reported = velocity is not None
        return estimate if velocity is None else velocity

    def start_from(self, position: float, velocity: float) -> None:
        """Let the estimate go on from a position in [rad] and a velocity in [rad/s]."""
        self._fallback.start_from(position, velocity)

    def reset(self) -> None:
        """Forget the past of the estimate."""
        self._fallback.reset()
        self._zeros, self.moved_at_zero = 0, 0.0


class HomogeneousDifferentiator(_LastState):
    r"""Levant's robust exact differentiator: exact for a bounded acceleration, after finite time.

    .. math::
        \dot z_0 = z_1 - 1.5\sqrt{L}\,|z_0 - x|^{1/2}\,\mathrm{sign}(z_0 - x), \qquad
        \dot z_1 = -1.1\,L\,\mathrm{sign}(z_0 - x)

    by backward Euler, where both signs become what makes the step consistent: it does not
    chatter, and on a track without noise it is the backward difference. With a position noise of
    at most eps the velocity is wrong by the order of max(sqrt(L eps), L T) whatever the motion,
    without the lag of a filter.

    Source: A. Levant, "Robust exact differentiation via sliding mode technique", Automatica 34
    (1998); the gains, A. Levant, "Higher-order sliding modes, differentiation and output-feedback
    control", Int. J. Control 76 (2003); the step, M. R. Mojallizadeh, B. Brogliato, V. Acary,
    "Time-discretizations of differentiators", Int. J. Robust Nonlinear Control 31 (2021).
    """

    __slots__ = ("acceleration_bound",)

    _POSITION_GAIN = 1.5
    _VELOCITY_GAIN = 1.1

    def __init__(self, acceleration_bound: float) -> None:
        if not math.isfinite(acceleration_bound) or acceleration_bound <= 0.0:
            raise SettingError(
                f"the differentiator's acceleration bound must be positive and finite, "
                f"not {acceleration_bound} rad/s^2"
            )
        self.acceleration_bound = acceleration_bound
        self.reset()

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the estimate in [rad/s]; the measured velocity is not used."""
        if self._position is None:
            self._position = position
            return self._velocity
        if dt <= 0.0:
            return self._velocity
        # The estimate s = z0 - x after the step solves s = ahead - T k |s|^{1/2} sign(s)
        # - T^2 c sign(s), with sign(0) anywhere in [-1, 1].
        ahead = self._position + dt * self._velocity - position
        change = self._VELOCITY_GAIN * self.acceleration_bound * dt
        beyond = abs(ahead) - change * dt
        if beyond <= 0.0:
            self._velocity -= ahead / dt
            self._position = position
        else:
            slope = self._POSITION_GAIN * math.sqrt(self.acceleration_bound) * dt
            root = 0.5 * (math.sqrt(slope * slope + 4.0 * beyond) - slope)
            self._velocity -= math.copysign(change, ahead)
            self._position = position + math.copysign(root * root, ahead)
        return self._velocity


LEAST_OBSERVER_DEGREE, LARGEST_OBSERVER_DEGREE = -0.33, 0.5
"""Between them an observer of three states is homogeneous and continuous: above -1/3."""

_LEAST_MEMORY = 1e-3  # of what is kept from one sample to the next, however long that takes
_SPAN = 4.0  # by which the degree may raise or lower the bandwidth


class ObserverDesign(NamedTuple):
    """What an observer goes by."""

    inertia: float  # [kg m^2] what one unit of effort accelerates, positive
    bandwidth: float  # [1/s] of the observer, positive
    period: float  # [s] nominal time between two samples, positive
    degree: float = 0.0  # homogeneity degree; 0 is the linear observer
    # [rad] innovation at which the bandwidth is bandwidth whatever the degree, positive
    innovation_scale: float = 1e-3


class Observer:
    r"""Extended state observer, by least squares whose memory fades.

    From sample to sample the double integrator is followed exactly, as for an effort that is held
    between them. What the measured position differs from it, the innovation e, corrects the state
    so that the squared differences of all samples, each weighed by
    :math:`\theta = e^{-\omega T}` for every period T that has passed since, are least:

    .. math::
        P^- = F P F' / \theta, \qquad k = P^- C' / (1 + C P^- C'), \qquad P = (I - k C) P^-

    At a constant period the gains are those of the observer with three equal poles at
    :math:`\theta`, ``bandwidth`` in continuous time. The error decays by :math:`\theta` or more in
    each sample in the norm :math:`x' P^{-1} x`, for every sequence of periods and bandwidths:
    jitter, lost samples and what the degree does to the bandwidth cannot make it unstable.

    With a degree other than 0 the bandwidth is multiplied by :math:`|\bar e / e_0|^{degree}`,
    between 1/4 and 4, where :math:`\bar e` is the innovation behind a low-pass of the time
    constant 1/bandwidth: the linear gains under the dilation of the innovation, with weights
    1, 1 + degree, 1 + 2 degree. A negative degree tightens close to the truth, and lets more noise
    through; a positive one is calm there.

    Source: gains under a dilation of the innovation, A. Polyakov, HCS Toolbox for MATLAB,
    "Homogeneous Observer"; why a prefilter, X. Ping, K. Zimenko, A. Polyakov, D. Efimov,
    "Filtering Homogeneous Observer for MIMO System", arXiv:2401.03135 (2024).
    """

    __slots__ = (
        "_acceleration",
        "_coasted",
        "_covariance",
        "_has_begun",
        "_innovation",
        "design",
        "disturbance",
        "position",
        "velocity",
    )

    position: float  # [rad] estimate after the last sample
    velocity: float  # [rad/s]
    disturbance: float  # [rad/s^2] w
    _covariance: tuple[float, float, float, float, float, float]
    _innovation: float
    _coasted: float
    _has_begun: bool

    def __init__(self, design: ObserverDesign) -> None:
        _check(design)
        self.design = design
        self._acceleration = 0.0
        self.reset()

    @property
    def effort(self) -> float:
        """The disturbance as an effort on the inertia, in [N m]; positive drives the joint up."""
        return self.design.inertia * self.disturbance

    def retune(self, design: ObserverDesign) -> None:
        """Go by another design from the next sample on; the estimates stay."""
        _check(design)
        # The effort sent gives another acceleration, and the joint moves on as before.
        before = self._acceleration
        self._acceleration *= self.design.inertia / design.inertia
        self.disturbance += before - self._acceleration
        self.design = design
        self._restart_covariance()

    def note_applied(self, effort: float) -> None:
        """Note what acts on the joint from the last sample on."""
        self._acceleration = effort / self.design.inertia

    def coast(self, dt: float) -> None:
        """Go on without a measurement, under the effort sent."""
        if self._has_begun:
            self._follow(dt)
            self._coasted += dt

    def _follow(self, dt: float) -> None:
        acceleration = self._acceleration + self.disturbance
        self.position += dt * (self.velocity + 0.5 * dt * acceleration)
        self.velocity += dt * acceleration

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the velocity in [rad/s]; the measured one is not used."""
        if not self._has_begun:
            self.start_from(position, self.velocity)
            return self.velocity
        if dt <= 0.0:
            return self.velocity
        self._follow(max(dt - self._coasted, 0.0))
        self._coasted = 0.0
        innovation = position - self.position
        k_position, k_velocity, k_disturbance = self._gains(innovation, dt)
        bandwidth = self.design.bandwidth
        self.position += k_position * innovation
        self.velocity += k_velocity * bandwidth * innovation
        self.disturbance += k_disturbance * bandwidth * bandwidth * innovation
        return self.velocity

    def _gains(self, innovation: float, dt: float) -> tuple[float, float, float]:
        """Take a sample into the covariance, and return what it makes of the gains.

        Both are in units of the bandwidth: of position, velocity / omega, disturbance / omega^2.
        """
        t = self.design.bandwidth * dt
        fading = t * self._multiplier(innovation, t) if self.design.degree else t
        growth = 1.0 / max(math.exp(-fading), _LEAST_MEMORY)
        xx, xv, xw, vv, vw, ww = self._covariance
        half = 0.5 * t * t
        xw_ahead = xw + t * vw + half * ww
        vw_ahead = vw + t * ww
        xv_ahead = xv + t * vv + half * vw + t * xw_ahead
        xx_ahead = xx + t * xv + half * xw + t * (xv + t * vv + half * vw) + half * xw_ahead
        vv_ahead = vv + t * vw + t * vw_ahead
        share = growth / (1.0 + growth * xx_ahead)
        k, kv, kw = share * xx_ahead, share * xv_ahead, share * xw_ahead
        vv = growth * (vv_ahead - kv * xv_ahead)
        ww = growth * (ww - kw * xw_ahead)
        if vv > 0.0 and ww > 0.0:
            vw = growth * (vw_ahead - kv * xw_ahead)
            self._covariance = k, kv, kw, vv, vw, ww
        else:  # rounding, where periods differ by many orders of magnitude: this one's from now on
            self._covariance = _stationary(t)
            k, kv, kw, *_ = self._covariance
        return k, kv, kw

    def _restart_covariance(self) -> None:
        """Begin with what endless sampling at the nominal period ends at."""
        self._covariance = _stationary(self.design.bandwidth * self.design.period)

    def _multiplier(self, innovation: float, t: float) -> float:
        """Return what the degree makes of the bandwidth, by the prefiltered innovation."""
        self._innovation += t / (1.0 + t) * (innovation - self._innovation)
        _, _, _, degree, scale = self.design
        size = min(max(abs(self._innovation) / scale, 1e-30), 1e30)
        return min(max(float(size**degree), 1.0 / _SPAN), _SPAN)

    def start_from(self, position: float, velocity: float) -> None:
        """Go on from where another source stands, as if all that acts were in balance."""
        self.position, self.velocity = position, velocity
        self.disturbance = -self._acceleration
        self._has_begun = True

    def reset(self) -> None:
        """Forget the past: the next sample is the first one, at rest and in balance."""
        self.position = self.velocity = self.disturbance = 0.0
        self._innovation = self._coasted = 0.0
        self._has_begun = False
        self._restart_covariance()


def _check(design: ObserverDesign) -> None:
    for name in ("inertia", "bandwidth", "period", "innovation_scale"):
        value = getattr(design, name)
        if not (math.isfinite(value) and value > 0.0):
            raise SettingError(f"the observer's {name} must be positive and finite, not {value}")
    if not LEAST_OBSERVER_DEGREE <= design.degree <= LARGEST_OBSERVER_DEGREE:
        raise SettingError(
            f"the observer's degree must lie in [{LEAST_OBSERVER_DEGREE:g}, "
            f"{LARGEST_OBSERVER_DEGREE:g}], not {design.degree}"
        )


_Covariance = tuple[float, float, float, float, float, float]


def _stationary(t: float) -> _Covariance:
    r"""Return the covariance that endless sampling at one period ends at.

    It is the inverse of :math:`\sum_j \theta^j c_j' c_j` with
    :math:`c_j = (1, -j t, j^2 t^2 / 2)`.
    """
    theta = max(math.exp(-t), _LEAST_MEMORY)
    rest = -math.expm1(-t) if theta > _LEAST_MEMORY else 1.0 - theta
    s0 = 1.0 / rest
    s1 = theta / rest**2
    s2 = theta * (1.0 + theta) / rest**3
    s3 = theta * (1.0 + theta * (4.0 + theta)) / rest**4
    s4 = theta * (1.0 + theta * (11.0 + theta * (11.0 + theta))) / rest**5
    a, b, c = s0, -s1 * t, 0.5 * s2 * t**2
    d, e, f = s2 * t**2, -0.5 * s3 * t**3, 0.25 * s4 * t**4
    xx, xv, xw = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * xx + b * xv + c * xw)
    return (
        scale * xx,
        scale * xv,
        scale * xw,
        scale * (a * f - c * c),
        scale * (b * c - a * e),
        scale * (a * d - b * b),
    )
