"""Anti-windup: the integral while the effort is limited.

The strategies and their definitions are those of ``control_toolbox``, so that a configuration
of ros2_control keeps its meaning.

Source: ``control_toolbox``, ``src/pid.cpp``, ``Pid::compute_command``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from hpid_ros.base.errors import SettingError
from hpid_ros.control.gains import Gains

STRATEGIES = ("none", "conditional_integration", "back_calculation")

AntiWindup = Callable[[float, float, float, float, float, float], float]
"""``(before, after, error, wanted, limited, dt) -> integral``.

``before`` and ``after`` are the integral before and after the law's own increment in [N m],
``error`` is in [rad], ``wanted`` and ``limited`` are the effort before and after the limits in
[N m], ``dt`` in [s]. The answer is the integral for the next sample in [N m].
"""


def anti_windup(strategy: str, gains: Gains, tracking_time_constant: float) -> AntiWindup:
    """Return the strategy of this name.

    Args:
        strategy: ``none`` | ``conditional_integration`` | ``back_calculation``.
        gains: For the default of the tracking time constant.
        tracking_time_constant: Of back calculation in [s]; 0 chooses ``sqrt(kd / ki)``, or
            ``kp / ki`` for a PI, as control_toolbox does.

    Raises:
        SettingError: No such strategy, or a time constant that is negative or not finite.
    """
    if not math.isfinite(tracking_time_constant) or tracking_time_constant < 0.0:
        raise SettingError(
            f"tracking_time_constant must be finite and not negative, "
            f"not {tracking_time_constant} s"
        )
    if strategy == "none" or (strategy == "back_calculation" and gains.i == 0.0):
        return _keep  # without an integral gain nothing winds up, and nothing would wind back
    if strategy == "conditional_integration":
        return _stop_while_pushing
    if strategy == "back_calculation":
        return _back_calculation(tracking_time_constant or _default_time_constant(gains))
    raise SettingError(
        f"antiwindup_strategy must be one of {', '.join(STRATEGIES)}, not {strategy!r}"
    )


def _keep(
    before: float, after: float, error: float, wanted: float, limited: float, dt: float
) -> float:
    return after


def _stop_while_pushing(
    before: float, after: float, error: float, wanted: float, limited: float, dt: float
) -> float:
    """Do not integrate while the effort is limited and the error pushes further into it."""
    return before if wanted != limited and error * wanted > 0.0 else after


def _back_calculation(time_constant: float) -> AntiWindup:
    """Draw the integral back with the time constant by what the limits took away."""

    def strategy(
        before: float, after: float, error: float, wanted: float, limited: float, dt: float
    ) -> float:
        return after + dt * (limited - wanted) / time_constant

    return strategy


def _default_time_constant(gains: Gains) -> float:
    return math.sqrt(gains.d / gains.i) if gains.d > 0.0 else gains.p / gains.i or math.inf
