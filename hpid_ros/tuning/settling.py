"""Whether decoupled joints settle that use each other's last efforts; see ``robot/coupling``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from hpid_ros.control import LoopSettings
from hpid_ros.robot.coupling import POSES, Coupling, relaxation


class Settling(NamedTuple):
    """What is known of the joints' efforts.

    Attributes:
        time_constant: Of the low-pass on the other joints' efforts in [s].
        radius: Factor by which the efforts' errors shrink in each sample, at the worst pose.
        text: The finding in one line, for people.
    """

    time_constant: float
    radius: float
    text: str

    @property
    def is_settling(self) -> bool:
        """Whether the errors shrink."""
        return self.radius < 1.0

    @classmethod
    def of(cls, settings: LoopSettings, coupling: Coupling) -> Settling:
        """Judge a loop with decoupling.

        Args:
            settings: The loop's.
            coupling: Of its model's joints.
        """
        period = settings.control_period
        time_constant = settings.model.effort_filter_time_constant
        if time_constant < 0.0:
            time_constant = coupling.filter_time_constant(period)
        radius = coupling.radius(relaxation(time_constant, period))
        if radius < 1.0:
            text = (
                f"efforts of the other joints, filtered by {1e3 * time_constant:.3g} ms, settle "
                f"by a factor {radius:.2f} in each sample (without a filter "
                f"{coupling.radius():.2f}), over {POSES} poses"
            )
        else:
            shortest = period * (0.5 * coupling.largest - 1.0)
            text = (
                f"decoupled joints would not settle: in each sample their last efforts change "
                f"the next ones by a factor of up to {radius:.3g}; "
                f"model.effort_filter_time_constant must exceed {shortest:.3g} s, "
                f"not {time_constant:g} s (-1 chooses it)"
            )
        return cls(time_constant, radius, text)


def settling_of(loops: Iterable[LoopSettings], robot: str) -> list[Settling]:
    """Judge loops with decoupling; those of one model and one rate are judged once.

    Args:
        loops: Settings of the loops.
        robot: The robot's URDF, XML text or path, where the settings name none.

    Raises:
        HpidError: A model's robot is not known or cannot be read.
    """
    from hpid_ros.tuning.compensation import coupling_of

    different = {(each.model, each.control_period): each for each in loops}
    return [Settling.of(each, coupling_of(each, robot)) for each in different.values()]
