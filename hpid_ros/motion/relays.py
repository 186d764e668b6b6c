r"""A relay within limits of a joint: how strong it is, and how far and how fast the joint goes.

From the harmonic balance of a double integrator under a relay of amplitude a with hysteresis h on
:math:`e + T \dot e`, without delay: a cycle of the rate :math:`\omega` has the amplitude
:math:`A = 4 a / (\pi m \omega^2)` and needs :math:`h = A\,T\,\omega`. Delay, and an inertia that
is not the one that was taken, make it larger; ``deviation`` ends it then.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.control.overrides import LONGEST, RAMP, RelayRequest
from hpid_ros.motion.excitation import JointBounds

_FOUR_OVER_PI = 4.0 / math.pi
_VELOCITY_SHARE = 0.3  # of the velocity limit
_SAMPLES = 16  # in a cycle, at least
_ROOM = 4.0  # amplitudes that the error may reach
_ROOM_SHARE = 0.8  # of the way to the nearer stop
_MORE_CYCLES, _SLOWER = 3, 4.0  # until the cycle stays; than was taken


class RelayWish(NamedTuple):
    """What a relay shall be like."""

    effort: float = 0.0  # [N m] its amplitude; 0 chooses a share
    share: float = 0.2  # of what is left of the effort limits beside the load
    amplitude: float = 0.05  # [rad] of the position
    cycles: int = 8  # whole cycles

    def require(self) -> None:
        """Refuse numbers that are no wish."""
        if not 0.0 < self.share <= 0.8:
            raise SettingError(f"the share of the effort must be in (0, 0.8], not {self.share:g}")
        if not (math.isfinite(self.effort) and self.effort >= 0.0):
            raise SettingError(f"the effort must be positive, not {self.effort:g}")
        if not (math.isfinite(self.amplitude) and self.amplitude > 0.0):
            raise SettingError(f"the amplitude must be positive, not {self.amplitude:g}")
        if not 5 <= self.cycles <= 50:
            raise SettingError(f"there must be 5 to 50 cycles, not {self.cycles}")


class PlannedRelay(NamedTuple):
    """A relay, and what is expected of it."""

    request: RelayRequest  # what the controller is asked for
    period: float  # [s] of the cycle
    amplitude: float  # [rad] of the position
    velocity: float  # [rad/s] largest


def planned_relay(
    bounds: JointBounds, lead: float, sample_time: float, wish: RelayWish
) -> PlannedRelay:
    """Return a relay within shares of a joint's limits."""
    wish.require()
    least, largest = bounds.efforts
    spare = min(largest - bounds.load, bounds.load - least)
    effort = wish.effort or wish.share * spare
    if not (0.0 < effort < spare and math.isfinite(effort)):
        raise SettingError(
            f"a relay of {effort:.4g} does not fit between {bounds.joint}'s load of "
            f"{bounds.load:.4g} and its effort limits, {least:.4g} and {largest:.4g}: "
            f"give --effort"
        )
    room = _ROOM_SHARE * min(bounds.upper - bounds.position, bounds.position - bounds.lower)
    amplitude = min(wish.amplitude, room / _ROOM)
    if not amplitude > 0.0:
        raise SettingError(f"{bounds.joint} is at a limit of its position: move it away first")
    push = _FOUR_OVER_PI * effort / bounds.inertia
    rate = max(math.sqrt(push / amplitude), push / (_VELOCITY_SHARE * bounds.velocity))
    fastest = 2.0 * math.pi / (_SAMPLES * sample_time)
    if rate > fastest:
        raise SettingError(
            f"a relay of {effort:.4g} would move {bounds.joint} by {amplitude:.3g} in "
            f"{2e3 * math.pi / rate:.3g} ms, fewer than {_SAMPLES} samples: lower --effort, or "
            f"raise --amplitude"
        )
    period, size = 2.0 * math.pi / rate, push / rate**2
    longest = (wish.cycles + _MORE_CYCLES) * period * _SLOWER + 2.0 * RAMP
    request = RelayRequest(
        effort,
        size * lead * rate,
        min(_ROOM * wish.amplitude, room),
        float(wish.cycles),
        min(longest, LONGEST),
    )
    return PlannedRelay(request, period, size, size * rate)
