"""What a simulated base says of itself, and what is true, at the times at which both are told.

Odometry and slip are added up once a control period, on simulated time alone, so that the bridge
and the run without ROS tell the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from hpid_ros.errors import SettingError
from hpid_ros.robot.differential_drive import BaseTwist, DifferentialDrive
from hpid_ros.robot.odometry import Odometry, PlanarCovariance, PlanarPose
from hpid_ros.simulation.poses import Pose
from hpid_ros.simulation.slip import Slip, SlipMeter
from hpid_ros.simulation.world import World

REPORT_RATE = 50.0
"""How often odometry, truth and slip are told in an experiment, in [Hz]."""

_NANOSECONDS = 1_000_000_000


class ReportTimes:
    """Tells which states come with a report: the first, then one a period, and the last of all.

    Args:
        rate: Reports a second of simulated time, in [Hz]; 0 is none at all.
        end_ns: Stamp of the last state in [ns]; None if there is none.
    """

    def __init__(self, rate: float, end_ns: int | None = None) -> None:
        self._period_ns = round(_NANOSECONDS / rate) if rate > 0.0 else 0
        self._end_ns = end_ns
        self._last_ns: int | None = None

    @property
    def is_off(self) -> bool:
        """Whether there is never a report."""
        return not self._period_ns

    def is_due(self, stamp_ns: int) -> bool:
        """Tell whether a state comes with a report; ask once for each state.

        Args:
            stamp_ns: Its stamp in [ns]; one that goes back begins anew.
        """
        if not self._period_ns:
            return False
        last_ns = self._last_ns
        is_soon = last_ns is not None and 0 <= stamp_ns - last_ns < self._period_ns
        if is_soon and stamp_ns != self._end_ns:
            return False
        self._last_ns = stamp_ns
        return True


class BaseReport(NamedTuple):
    """Odometry of the wheels beside the truth.

    Attributes:
        stamp_ns: Of the state, in [ns].
        pose: Where the base is by its wheels, from where it stood at time 0.
        covariance: Of the pose.
        twist: By the wheels, its mean since the report before.
        twist_variance: Of the linear [m^2/s^2] and the angular rate [rad^2/s^2].
        slip: Of the wheels up to now.
    """

    stamp_ns: int
    pose: PlanarPose
    covariance: PlanarCovariance
    twist: BaseTwist
    twist_variance: tuple[float, float]
    slip: Slip


class BaseMonitor:
    """Follows the base of a world; begins anew when time goes back.

    Attributes:
        drive: The base.

    Args:
        world: A world whose settings name a base.

    Raises:
        SettingError: They do not.
    """

    def __init__(self, world: World) -> None:
        settings = world.settings
        if settings.base is None:
            raise SettingError("the world has no base: its settings name none")
        self.drive: DifferentialDrive = settings.base
        self._world = world
        self._left, self._right = (settings.joints.index(joint) for joint in self.drive.joints)
        steps = [math.tau / count for count in self._counts() if count]
        self._quantum = self.drive.radius * max(steps, default=0.0)  # [m]
        self._stamp_ns: int | None = None
        self._odometry: Odometry
        self._slip: SlipMeter

    @property
    def slip(self) -> Slip:
        """Slip up to the last state that was noted."""
        return Slip(0.0, 0.0, 0.0) if self._stamp_ns is None else self._slip.slip

    @property
    def distance(self) -> float:
        """Distance that the wheels have driven so far, there and back both counted, in [m]."""
        return 0.0 if self._stamp_ns is None else self._driven

    def note(self, positions: Sequence[float]) -> None:
        """Take the present state of the world, once for each state.

        Args:
            positions: Measured positions of the driven joints, in [rad].
        """
        now_ns = self._world.time_ns
        left, right = positions[self._left], positions[self._right]
        true = self._world.true_positions()
        wheels = true[self._left], true[self._right]
        pose = planar(self._world.base_pose())
        if self._stamp_ns is None or now_ns < self._stamp_ns:
            self._odometry = Odometry(self.drive, left, right)
            self._slip = SlipMeter(self.drive, wheels, pose)
            self._before = now_ns, 0.0, 0.0
            self._driven = 0.0
        else:
            before = self._odometry.distance
            self._odometry.update(left, right)
            self._driven += abs(self._odometry.distance - before)
            self._slip.update(wheels, pose)
        self._stamp_ns = now_ns

    def report(self) -> BaseReport:
        """Return how the base is now; the next twist counts from here.

        Raises:
            SettingError: No state was noted.
        """
        if self._stamp_ns is None:
            raise SettingError("a base can be reported when a state has been noted, not before")
        odometry = self._odometry
        then_ns, distance, turn = self._before
        seconds = (self._stamp_ns - then_ns) / _NANOSECONDS
        twist, variance = BaseTwist(0.0, 0.0), (0.0, 0.0)
        if seconds > 0.0:
            twist = odometry.twist_between(distance, turn, seconds)
            variance = self._twist_variance(seconds)
        self._before = self._stamp_ns, odometry.distance, odometry.turn
        return BaseReport(
            self._stamp_ns, odometry.pose, odometry.covariance, twist, variance, self._slip.slip
        )

    def _counts(self) -> tuple[int, int]:
        counts = self._world.settings.counts
        return counts[self._left], counts[self._right]

    def _twist_variance(self, seconds: float) -> tuple[float, float]:
        """Return what two roundings of each encoder leave of a difference of readings."""
        of_wheel = self._quantum**2 / 6.0 / seconds**2
        return 0.5 * of_wheel, 2.0 * of_wheel / self.drive.separation**2


def planar(pose: Pose) -> PlanarPose:
    """Return a pose in the plane: x, y and yaw in (-pi, pi].

    Args:
        pose: A pose in the world.
    """
    x, y, z, w = pose.orientation
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return PlanarPose(pose.position[0], pose.position[1], heading)
