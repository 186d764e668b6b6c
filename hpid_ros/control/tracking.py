"""Tracking: from a state that counts to the effort that answers it, and how it is changed."""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.control.estimation.estimation import Estimation
from hpid_ros.control.estimation.velocity import VelocitySource
from hpid_ros.control.interludes.relay import Relay, RelayRequest, reason_against
from hpid_ros.control.limited_law import LimitedLaw, ModelTerm
from hpid_ros.control.loop_state import LoopCounts
from hpid_ros.control.reference import Following, Motion
from hpid_ros.control.reference.feedforward import Feedforward
from hpid_ros.control.settings.assembly import feedforward_figures, turn_of_references
from hpid_ros.control.settings.loop import LoopSettings


class Tracked(NamedTuple):
    """What tracking was at some time; see :meth:`Tracking.kept`."""

    settings: LoopSettings
    following: Following
    feedforward: Feedforward
    velocity: VelocitySource
    integral: float


class Tracking:
    """A joint's reference, its estimated motion, and what feedforward and law make of both.

    It is told of states that count alone, and how much time there was between two of them; which
    these are is for :class:`~hpid_ros.control.joint_loop.JointLoop`.
    """

    __slots__ = (
        *("_settings", "_takeover_time"),
        *("error", "estimation", "feedforward", "following", "law", "relay"),
    )

    def __init__(self, settings: LoopSettings, counts: LoopCounts) -> None:
        self.relay: Relay | None = None
        self.following = Following()
        self.law = LimitedLaw(settings, counts)
        self.estimation = Estimation(settings, self.law)
        self.feedforward = Feedforward(feedforward_figures(settings))
        self.error = 0.0
        self._adopt(settings)

    def _adopt(self, settings: LoopSettings) -> None:
        """Take from settings what is looked at in each sample."""
        self._settings, self._takeover_time = settings, settings.timing.takeover_time
        self.following.turn = turn_of_references(settings)
        self.following.lost_turn = max(settings.encoder.wrap, 0.0)

    def reset(self) -> None:
        """Forget integral and velocity; start the motion anew with the next state."""
        self.law.reset()
        self.estimation.reset()
        self.feedforward.reset()
        self.following.restart()
        self.error = 0.0

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on."""
        self.end_relay("a reference came")
        self.following.follow(motion)

    def retune(self, settings: LoopSettings, position: float | None, stamp_ns: int) -> None:
        """Go by other settings; the integral term stays, and what is estimated is carried over."""
        self.end_relay("parameters were set")
        self.estimation.retune(settings, position)
        self.law.retune(
            settings, None if position is None else (position, self.estimation.velocity)
        )
        self.estimation.feed_anew()
        change = self.feedforward.retune(
            feedforward_figures(settings), self.following.velocity, self.following.acceleration
        )
        self._adopt(settings)
        if change:
            self._hand_over(change, stamp_ns)

    def begin(self, stamp_ns: int, position: float, *, is_takeover: bool) -> None:
        """Start from where the joint is, before its sample."""
        if self.law.limits is not None:
            self.law.limits.open(position)
        if not is_takeover:
            self.following.stand(position)
            return
        if self.law.relay is not None:
            self.drop_relay("the joint was taken over anew")
            self.law.give(self.law.effort)  # what the relay gave is in no term
        self.estimation.restart()
        self.following.take_over(stamp_ns, position, self._takeover_time)

    def update(
        self,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        dt: float,
        elapsed: float,
        model: ModelTerm | None,
        is_takeover: bool,
    ) -> float:
        """Take one sample and return its effort in [N m], within the limits."""
        law, following, estimation = self.law, self.following, self.estimation
        model = estimation.update(position, velocity, dt, model)
        speed = estimation.velocity
        wanted, rate, acceleration = following.sample(stamp_ns, self._takeover_time, law.limits)
        if rate and law.relay is not None:
            law.relay.end("the reference moves")
        ahead = 0.0
        if self.feedforward.is_active or following.gives_effort:
            ahead = self._feed_forward(stamp_ns, is_takeover=is_takeover)
        if is_takeover:
            law.take_over(model, acceleration, ahead, is_still_damped=dt > 0.0)
        self.error = error = wanted - estimation.position
        try:
            return law.update(
                error, rate - speed, position, speed, elapsed, model, acceleration, ahead
            )
        except ArithmeticError:
            estimation.restart()
            raise

    def _feed_forward(self, stamp_ns: int, *, is_takeover: bool) -> float:
        """Return the effort that the reference of this sample needs, in [N m]."""
        forward, following = self.feedforward, self.following
        planned = following.effort(stamp_ns)
        if is_takeover:
            forward.reset()
        elif following.has_turned:
            self._hand_over(forward.change_by(planned), stamp_ns)
        following.has_turned = False
        return forward.update(stamp_ns, following.velocity, following.acceleration, planned)

    def _hand_over(self, change: float, stamp_ns: int) -> None:
        """Let the effort stay what it is although what is fed forward changes, in [N m]."""
        left = self.law.give_up(change)
        if left:
            self.feedforward.keep(-left, stamp_ns, self._takeover_time)

    def begin_relay(self, request: RelayRequest, against: str) -> None:
        """Let a relay drive the joint for some cycles, around where it is held."""
        law, gains = self.law, self._settings.gains
        if law.relay is not None:
            against = "there is one already"
        elif not against and (self.following.velocity or self.following.acceleration):
            against = "the reference moves"
        against = against or reason_against(
            request, gains, self._settings.effort, law.integral + law.model_effort, self.error
        )
        if against:
            raise SettingError(f"no relay now: {against}")
        self.relay = law.relay = Relay(request, gains.d / gains.p)

    def end_relay(self, reason: str) -> None:
        """Let a relay give back, if there is one."""
        if self.law.relay is not None:
            self.law.relay.end(reason)

    def drop_relay(self, reason: str) -> None:
        """End a relay at once, without another effort: who calls decides about that."""
        self.end_relay(reason)
        self.law.relay = None

    def kept(self) -> Tracked:
        """Return what :meth:`go_back_to` needs."""
        return Tracked(
            self._settings,
            copy(self.following),
            copy(self.feedforward),
            self.estimation.copy_of_source(),
            self.law.own_integral,
        )

    def go_back_to(self, before: Tracked) -> None:
        """Be what it was, but for what it was told since."""
        told = self.following.motion
        self.following = before.following
        if told is not before.following.motion:
            self.following.follow(told)
        if self._settings is before.settings:  # else the source is another, or of other figures
            self.estimation.put_back(before.velocity)
            self.feedforward = before.feedforward
        self.law.restore_integral(before.integral)
