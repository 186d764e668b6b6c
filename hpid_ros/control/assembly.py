"""The parts of a joint loop, made of its settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from hpid_ros.control.homogeneous_pid import HomogeneousPid, Pid, SemiImplicitHomogeneousPid
from hpid_ros.control.laws import LawName
from hpid_ros.control.limits import AntiWindup, MotionBounds, MotionLimits, anti_windup
from hpid_ros.control.norms import Norm
from hpid_ros.control.reference import FeedforwardGains
from hpid_ros.control.settings import (
    LARGEST_MOTION,
    EncoderSettings,
    LoopSettings,
    VelocitySettings,
)
from hpid_ros.control.sources import SourceBounds, source_bounds
from hpid_ros.control.velocity import (
    FilteredVelocity,
    HomogeneousDifferentiator,
    MeasuredVelocity,
    ObserverDesign,
    Unwrapper,
    VelocitySource,
)

_ALLOWANCE = 0.1  # [rad], for noise and coarse encoders
_OBSERVER_LEAD = 4.0  # of the observer's bandwidth over d / inertia
_SLOWEST, _FASTEST = 1.0, 1e4  # [1/s], bandwidths chosen for an observer
_INNOVATION_SCALE = 1e-3  # [rad], where the encoder's step is unknown
_K_POSITION = 10.0  # [1/s], of a soft stop where the gains say nothing


def make_norm(settings: LoopSettings) -> Norm:
    """Return the norm of degree ``mu``, whether or not the law uses it."""
    return settings.norm_family(settings.mu)


def make_law(settings: LoopSettings) -> Pid:
    """Return the control law, its integral at zero."""
    return _MAKERS[settings.law](settings)


def _make_pid(settings: LoopSettings) -> Pid:
    if settings.discretization == "semi_implicit":  # which is the homogeneous one of degree 0
        return _make_hpid(settings)
    return Pid(settings.gains)


def _make_hpid(settings: LoopSettings) -> HomogeneousPid:
    norm = settings.norm_family(settings.degree)
    floor, cap = settings.norm_floor, settings.norm.cap
    if settings.discretization == "explicit":
        return HomogeneousPid(settings.gains, norm, floor, cap)
    return SemiImplicitHomogeneousPid(
        settings.gains,
        norm,
        floor,
        cap,
        inertia=settings.plant_inertia,
        period=settings.timing.control_period,
    )


_MAKERS: Mapping[LawName, Callable[[LoopSettings], Pid]] = {"pid": _make_pid, "hpid": _make_hpid}


def observer_design(settings: LoopSettings) -> ObserverDesign | None:
    """Return what the observer goes by; None where there is none, or the inertia is unknown."""
    inertia, wanted = settings.plant_inertia, settings.observer
    if settings.velocity.velocity_source != "observer" or not inertia:
        return None
    chosen = min(max(_OBSERVER_LEAD * settings.gains.d / inertia, _SLOWEST), _FASTEST)
    return ObserverDesign(
        inertia=inertia,
        bandwidth=wanted.bandwidth or chosen,
        period=settings.timing.control_period,
        degree=wanted.degree,
        innovation_scale=(
            wanted.innovation_scale or settings.encoder.encoder_resolution or _INNOVATION_SCALE
        ),
    )


def feedforward_gains(settings: LoopSettings) -> FeedforwardGains:
    """Return what is fed forward. With a model, planned efforts are not: it contains them."""
    wanted = settings.feedforward
    return FeedforwardGains(
        inertia=settings.inertia if wanted.inertia < 0.0 else wanted.inertia,
        viscous_friction=max(wanted.viscous_friction, 0.0),
        coulomb_friction=max(wanted.coulomb_friction, 0.0),
        friction_velocity=wanted.friction_velocity,
        uses_planned_effort=wanted.trajectory_effort and not settings.model.is_on,
    )


def make_velocity_source(settings: VelocitySettings) -> VelocitySource:
    """Return the velocity source, without a past; for an observer the filtered difference."""
    if settings.velocity_source == "homogeneous_differentiator":
        return HomogeneousDifferentiator(settings.acceleration_bound)
    if settings.velocity_source in ("filtered", "observer"):
        return FilteredVelocity(settings.velocity_filter_time_constant)
    return MeasuredVelocity(settings.velocity_filter_time_constant)


def make_unwrapper(settings: EncoderSettings) -> Unwrapper | None:
    """Return what makes the positions continuous; None where the encoder does not wrap."""
    return Unwrapper(settings.encoder_wrap) if settings.encoder_wrap > 0.0 else None


def bounds_of_source(settings: LoopSettings) -> SourceBounds:
    """Return what the states of one source may do, by the settings of a joint."""
    encoder, timing = settings.encoder, settings.timing
    return source_bounds(
        resolution=encoder.encoder_resolution,
        step_max=encoder.position_step_max,
        wrap=encoder.encoder_wrap,
        timeout=timing.state_timeout,
        is_simulated=timing.is_simulated,
    )


def turn_of_references(settings: LoopSettings) -> float:
    """Return the turn by whose multiples a new reference may be shifted, in [rad]; 0: by none.

    References a turn of the encoder apart are the same, unless parameters say otherwise.
    """
    motion, wrap = settings.motion, settings.encoder.encoder_wrap
    if motion.angle_wraparound:
        return math.tau
    return 0.0 if motion.multi_turn or motion.has_stop else max(wrap, 0.0)


def make_anti_windup(settings: LoopSettings) -> AntiWindup:
    """Return the anti-windup strategy."""
    integral = settings.integral
    return anti_windup(
        integral.antiwindup_strategy, settings.gains, integral.tracking_time_constant
    )


def make_motion_limits(settings: LoopSettings) -> MotionLimits | None:
    """Return the limits of position, velocity and effort rate; None where there are none."""
    motion, effort = settings.motion, settings.effort
    lower, upper, fastest = motion.lower, motion.upper, motion.fastest
    rate = effort.effort_rate_max or math.inf
    if -lower == upper == fastest == rate == math.inf:
        return None
    k_position, k_velocity = soft_stop_gains(settings)
    return MotionLimits(
        MotionBounds(
            lower=lower,
            upper=upper,
            velocity=fastest,
            margin=motion.soft_stop.margin,
            k_position=k_position,
            k_velocity=k_velocity,
            rate=rate,
            effort_min=effort.u_clamp_min,
            effort_max=effort.u_clamp_max,
        )
    )


def largest_step(settings: LoopSettings) -> tuple[float, float]:
    """Return what a position may differ from the last one: in [rad], and in [rad/s] of the time.

    A load may drive a joint beyond its velocity limit, and a stamp may be a period late: twice
    ``velocity_max`` is allowed over one period more than the stamps tell.
    """
    fastest = settings.motion.fastest
    has_limit = fastest < math.inf
    allowance = settings.encoder.position_step_max or (_ALLOWANCE if has_limit else math.pi)
    if allowance >= LARGEST_MOTION:
        return math.inf, 0.0
    allowed = 2.0 * fastest if has_limit else 0.0
    return allowance + allowed * settings.timing.control_period, allowed


def soft_stop_gains(settings: LoopSettings) -> tuple[float, float]:
    """Return the gains of the soft stops in [1/s] and [N m s/rad].

    Three equal poles at -w mean p = 3 w^2 m and d = 3 w m: then 0.75 p / d is d / (4 m), where a
    stop is critically damped. A known inertia says it itself, and keeps the braking within what
    sampling allows.
    """
    given, inertia = settings.motion.soft_stop, settings.inertia
    scale = inertia if settings.model.is_decoupling and inertia else 1.0
    p, d = scale * settings.gains.p, scale * settings.gains.d
    k_position = given.k_position or (0.75 * p / d if p and d else _K_POSITION)
    k_velocity = given.k_velocity or d or p / k_position
    if inertia > 0.0:
        if not given.k_velocity:
            k_velocity = min(k_velocity, 0.5 * inertia / settings.timing.control_period)
        if not given.k_position and k_velocity:
            k_position = min(k_position, k_velocity / (4.0 * inertia))
    return k_position, k_velocity
