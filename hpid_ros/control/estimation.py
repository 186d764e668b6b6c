"""Position and velocity that a loop uses, from its velocity source or an observer."""

from __future__ import annotations

from hpid_ros.control.assembly import make_velocity_source, observer_design
from hpid_ros.control.settings import LoopSettings
from hpid_ros.control.velocity import FilteredVelocity, MeasuredVelocity, Observer, VelocitySource

MOVED_AT_ZERO = 0.05
"""Distance [rad] after which velocities that are all 0 are taken not to be measured."""


class Estimation:
    """What a loop takes for the joint's position and velocity.

    That is the measured position and the velocity of a source, or both by an observer, which gets
    the efforts that are sent and may have the disturbance that it estimates fed forward.
    """

    __slots__ = (
        "_fade_time",
        "_observer",
        "_opposing",
        "_position_offset",
        "_settings",
        "_source",
        "position",
        "velocity",
    )

    def __init__(self, settings: LoopSettings) -> None:
        self._settings = settings
        self._use_source()
        self.reset()

    def _use_source(self) -> None:
        design = observer_design(self._settings)
        self._observer: Observer | None = None
        self._source: VelocitySource
        if design is not None:
            self._source = self._observer = Observer(design)
        else:
            self._source = make_velocity_source(self._settings.velocity)

    def reset(self) -> None:
        """Forget the past."""
        self._source.reset()
        self.position = self.velocity = 0.0
        self._position_offset = self._fade_time = 0.0  # [rad] of a former observer, [s] to fade it
        self._opposing = 0.0  # [N m] of the last sample against the observer's disturbance

    def forget_velocity(self) -> None:
        """Forget the velocity's past; the effort fed forward stays."""
        self._source.reset()
        self._position_offset = 0.0

    @property
    def has_observer(self) -> bool:
        """Whether position and velocity are an observer's."""
        return self._observer is not None

    def retune(
        self, settings: LoopSettings, position: float | None, effort: float, model_gain: float
    ) -> None:
        """Use other settings; what is estimated is carried over, with the effort now sent."""
        before, self._settings = self._settings, settings
        design = observer_design(settings)
        if design is not None and self._observer is not None:
            if design != self._observer.design:
                self.note_applied(effort, model_gain)
                self._observer.retune(design)
        elif (
            design is not None
            or self._observer is not None
            or settings.velocity.in_use != before.velocity.in_use
        ):
            observed = self.position if self._observer is not None else None
            self._use_source()
            if position is None:
                return
            if self._observer is not None:
                self._position_offset, position = 0.0, self.position
                self.note_applied(effort, model_gain)
            elif observed is not None:
                self._position_offset = observed - position
                self._fade_time = settings.timing.takeover_time
            self._source.start_from(position, self.velocity)

    def recompute_opposing(self, model_gain: float) -> float:
        """Compute the effort against the disturbance again; return its decrease in [N m]."""
        before, self._opposing = self._opposing, 0.0
        return before - (self.oppose(model_gain) if self.opposes_disturbance else 0.0)

    def note_applied(self, effort: float, model_gain: float) -> None:
        """Give the observer, if there is one, what acts on the joint from the last sample on.

        That is the effort sent without the model's own, over the model's gain.
        """
        if self._observer is not None:
            self._observer.note_applied(effort + self._opposing / model_gain)

    def coast(self, dt: float) -> None:
        """Let the observer, if there is one, go on under the effort sent, without a sample."""
        if self._observer is not None:
            self._observer.coast(dt)

    def update(self, position: float, velocity: float | None, dt: float) -> None:
        """Take a sample."""
        observer = self._observer
        if observer is None:
            self.position = position + self._fade(dt) if self._position_offset else position
            self.velocity = self._source.update(position, velocity, dt)
            return
        observer.update(position, None, dt)
        self.position, self.velocity = observer.position, observer.velocity

    @property
    def opposes_disturbance(self) -> bool:
        """Whether effort against an observed disturbance is fed forward."""
        return self._observer is not None and self._settings.observer.feed_disturbance

    def oppose(self, model_gain: float) -> float:
        """Return the effort against the disturbance that the observer estimates, in [N m]."""
        assert self._observer is not None
        self._opposing = -model_gain * self._observer.effort
        return self._opposing

    def _fade(self, dt: float) -> float:
        """Return what is left of the distance by which an observer was off, in [rad]."""
        left = max(self._fade_time - dt, 0.0)
        self._position_offset *= left / self._fade_time if self._fade_time else 0.0
        self._fade_time = left
        return self._position_offset

    def velocity_source_for_stop(self, position: float) -> VelocitySource:
        """Return the velocity source of a stop that takes the law's place."""
        if self._observer is None:
            return self._source
        # An observer knows the efforts of the loop, not those of the stop.
        source = FilteredVelocity(self._settings.velocity.velocity_filter_time_constant)
        source.start_from(position, self.velocity)
        return source

    def observer_state(self, model_gain: float) -> tuple[float, float, float] | None:
        """Return position [rad], velocity [rad/s] and disturbing effort [N m] by the observer."""
        observer = self._observer
        if observer is None:
            return None
        return observer.position, observer.velocity, model_gain * observer.effort

    @property
    def origin(self) -> str:
        """Where the velocity of the last sample came from."""
        if isinstance(self._source, MeasuredVelocity) and not self._source.is_reported:
            return "filtered, the states have none"
        if self._lacks_inertia:
            return "filtered, the inertia is unknown"
        return self._settings.velocity.velocity_source

    @property
    def warning(self) -> str:
        """What speaks against the velocities of the states; empty if nothing does."""
        source = self._source
        if isinstance(source, MeasuredVelocity) and source.moved_at_zero > MOVED_AT_ZERO:
            return (
                f"the velocities of the states are all 0, and the joint has moved by "
                f"{source.moved_at_zero:.2g} rad: nothing damps it; velocity_source filtered "
                "does without them"
            )
        if self._lacks_inertia:
            return (
                "velocity_source observer needs the parameter inertia, which is unknown: "
                "differences of the position are filtered in its place"
            )
        return ""

    @property
    def _lacks_inertia(self) -> bool:
        return self._settings.velocity.velocity_source == "observer" and self._observer is None
