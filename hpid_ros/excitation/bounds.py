"""What a joint may do while it is excited: its limits, and a share of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.excitation.courses import Peaks

_DAMPING_RATIO = 1.0  # of the loop that gains are taken to be tuned for
_UNSEEN_VELOCITY, _UNSEEN_ACCELERATION = 1.0, 5.0  # [rad/s, rad/s^2] where nothing is known


@dataclass(frozen=True)
class JointBounds:
    """Limits of a joint and where it is; "rad" reads "m" where it slides."""

    joint: str  # its name
    controller: str  # full name of its controller's node
    position: float  # [rad] where it is
    load: float  # [N m] effort that holds it there
    lower: float  # [rad] lowest position; -inf for none
    upper: float  # [rad] highest position; inf for none
    velocity: float  # [rad/s] largest velocity; inf if unknown
    efforts: tuple[float, float]  # [N m] least and largest effort; infinite if unknown
    inertia: float  # [kg m^2] what one unit of effort accelerates
    is_inertia_guessed: bool = False  # whether that was taken from the gains
    is_slide: bool = False  # whether it slides
    is_endless: bool = False  # whether it turns without end

    @property
    def unit(self) -> str:
        """Of its position."""
        return "m" if self.is_slide else "rad"


class Wish(NamedTuple):
    """What an excitation shall not exceed, beside shares of the limits."""

    # of each limit, of what is left of it where the joint is and how it is loaded
    share: float = 0.5
    amplitude: float = 0.5  # [rad]
    velocity: float = math.inf  # [rad/s] inf for no wish
    acceleration: float = math.inf  # [rad/s^2] inf for no wish

    def require(self) -> None:
        """Refuse numbers that are no wish."""
        if not 0.0 < self.share <= 0.9:
            raise SettingError(f"a share of the limits must be in (0, 0.9], not {self.share:g}")
        for name, value in self._asdict().items():
            if name != "share" and not value > 0.0:
                raise SettingError(f"the largest {name} must be positive, not {value:g}")


class Allowed(NamedTuple):
    """What a joint's excitation may reach, and why not more."""

    peaks: Peaks  # position, velocity and acceleration
    notes: tuple[str, ...]  # what was assumed, in words


def inertia_from_gains(p: float, d: float) -> float:
    """Return the inertia at which gains make a loop of damping ratio 1: d^2 / (4 p).

    Whoever tuned a PD loop gave it a damping ratio of about 1, so this is the inertia to an order
    of magnitude; it decides about nothing but the size of an excitation.
    """
    if not (p > 0.0 and d > 0.0):
        raise SettingError("the inertia is unknown, and gains.p and gains.d are not both positive")
    return d * d / (4.0 * _DAMPING_RATIO**2 * p)


def allowed(bounds: JointBounds, wish: Wish) -> Allowed:
    """Return what an excitation of a joint may reach."""
    notes = []
    room = min(bounds.upper - bounds.position, bounds.position - bounds.lower)
    if not room > 0.0:
        raise SettingError(
            f"{bounds.joint} is at {bounds.position:.4g} {bounds.unit}, beyond its limits of "
            f"{bounds.lower:.4g} and {bounds.upper:.4g} {bounds.unit}"
        )
    velocity, acceleration = min(wish.share * bounds.velocity, wish.velocity), wish.acceleration
    if math.isinf(velocity):
        velocity = _UNSEEN_VELOCITY
        notes.append(f"no velocity limit is known: {velocity:g} {bounds.unit}/s is taken")
    least, largest = bounds.efforts
    spare = wish.share * min(largest - bounds.load, bounds.load - least)
    if not spare > 0.0:
        raise SettingError(
            f"{bounds.joint} is held by {bounds.load:.4g}, its effort limits are {least:.4g} and "
            f"{largest:.4g}: there is nothing left to move it"
        )
    acceleration = min(acceleration, spare / bounds.inertia)
    if math.isinf(acceleration):
        acceleration = _UNSEEN_ACCELERATION
        notes.append(f"no effort limit is known: {acceleration:g} {bounds.unit}/s^2 is taken")
    elif bounds.is_inertia_guessed and not math.isinf(spare):
        unit = "kg" if bounds.is_slide else "kg m^2"
        notes.append(f"its inertia is taken from its gains, {bounds.inertia:.3g} {unit}")
    amplitude = min(wish.share * room, wish.amplitude)
    return Allowed(Peaks(amplitude, velocity, acceleration), tuple(notes))
