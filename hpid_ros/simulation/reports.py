"""Reports of a simulated robot with its joint states, as serialised messages.

Odometry, true motion and slip of its base, the clock, poses and grips. Odometry and slip are
added up once a control period, on simulated time alone. The bridge publishes the reports and a
run in one process writes them into its bag: the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages import reports as wire
from hpid_ros.robot.differential_drive import (
    BaseTwist,
    DifferentialDrive,
    Odometry,
    PlanarPose,
    chord_share,
)
from hpid_ros.simulation.gripper import (
    BRICK_POSES,
    END_EFFECTOR,
    GRIP_EVENTS,
    GripEvent,
    Gripper,
    grip_status,
    task_topics,
)
from hpid_ros.simulation.physics import Pose, Twist
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World


class Slip(NamedTuple):
    """Distances that the contacts have slid, there and back both counted."""

    left: float  # [m] of the left wheel along its track
    right: float  # [m] of the right wheel along its track
    lateral: float  # [m] of the axle, sideways


class SlipMeter:
    """Compares what the wheels rolled with where the axle's ends truly went.

    In each period the base is taken to move on an arc. A wheel's slip is its travel less that of
    its end of the axle along the arc; the axle's lateral slip is what the arc does not explain.
    """

    def __init__(
        self, drive: DifferentialDrive, wheels: tuple[float, float], pose: PlanarPose
    ) -> None:
        self._drive, self._wheels, self._pose = drive, wheels, pose
        self.slip = Slip(0.0, 0.0, 0.0)

    def update(self, wheels: tuple[float, float], pose: PlanarPose) -> None:
        """Take where wheels and base are one period later, as in the constructor."""
        drive, before = self._drive, self._pose
        of_left, of_right = (
            drive.radius * (now - then) for now, then in zip(wheels, self._wheels, strict=True)
        )
        turn = math.remainder(pose.heading - before.heading, math.tau)
        middle = before.heading + 0.5 * turn
        dx, dy = pose.x - before.x, pose.y - before.y
        c, s = math.cos(middle), math.sin(middle)
        travel = (dx * c + dy * s) / chord_share(turn)
        side = 0.5 * drive.separation * turn
        left, right, lateral = self.slip
        self.slip = Slip(
            left + abs(of_left - (travel - side)),
            right + abs(of_right - (travel + side)),
            lateral + abs(dy * c - dx * s),
        )
        self._wheels, self._pose = wheels, pose


REPORT_RATE = 50.0
"""How often odometry, truth and slip are published in an experiment, in [Hz]."""


class ReportTimes:
    """Tells which states come with a report: the first, then one a period, and the last of all."""

    def __init__(self, rate: float, end_ns: int | None = None) -> None:
        self.period_ns = round(NANOSECONDS / rate) if rate > 0.0 else 0  # 0: never a report
        self._end_ns = end_ns
        self._last_ns: int | None = None

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether a state comes with a report; ask once for each state."""
        if not self.period_ns:
            return False
        last_ns = self._last_ns
        is_soon = last_ns is not None and 0 <= stamp_ns - last_ns < self.period_ns
        if is_soon and stamp_ns != self._end_ns:
            return False
        self._last_ns = stamp_ns
        return True


OdometryValues = tuple[Pose, Sequence[float], Twist, Sequence[float]]
"""Pose of a base in ``odom``, twist in its own frame (REP 105), each with its covariance.

Of x, y, z and the rotations about them, row by row, 36 numbers, in [m^2], [m rad], [rad^2], and
the same units per s^2 of the twist.
"""


class BaseMonitor:
    """Follows the base of a world; starts again when time goes back."""

    def __init__(self, world: World) -> None:
        settings = world.settings
        if settings.base is None:
            raise SettingError("the world has no base: its settings name none")
        self.drive: DifferentialDrive = settings.base
        self._world = world
        self._left, self._right = (settings.joints.index(joint) for joint in self.drive.joints)
        counts = settings.counts[self._left], settings.counts[self._right]
        steps = [math.tau / count for count in counts if count]
        self._quantum = self.drive.radius * max(steps, default=0.0)  # [m]
        self._stamp_ns: int | None = None
        self._odometry: Odometry
        self._meter: SlipMeter
        self.slip = Slip(0.0, 0.0, 0.0)  # up to the last state that was noted
        self.distance = 0.0  # [m] that the wheels have driven, there and back both counted

    def note(self, positions: Sequence[float]) -> None:
        """Take the present state of the world, once for each state."""
        now_ns = self._world.time_ns
        left, right = positions[self._left], positions[self._right]
        true = self._world.true_positions()
        wheels = true[self._left], true[self._right]
        pose = planar(self._world.base_pose())
        if self._stamp_ns is None or now_ns < self._stamp_ns:
            self._odometry = Odometry(self.drive, left, right)
            self._meter = SlipMeter(self.drive, wheels, pose)
            self._before = now_ns, 0.0, 0.0
            self.distance = 0.0
        else:
            before = self._odometry.distance
            self._odometry.update(left, right)
            self.distance += abs(self._odometry.distance - before)
            self._meter.update(wheels, pose)
        self.slip, self._stamp_ns = self._meter.slip, now_ns

    def report(self) -> OdometryValues:
        """Return odometry of the wheels; its twist is the mean since the report before."""
        if self._stamp_ns is None:
            raise SettingError("a base can be reported when a state has been noted, not before")
        odometry = self._odometry
        then_ns, distance, turn = self._before
        seconds = (self._stamp_ns - then_ns) / NANOSECONDS
        twist, of_wheel = BaseTwist(0.0, 0.0), 0.0
        if seconds > 0.0:
            twist = odometry.twist_between(distance, turn, seconds)
            # What two roundings of each encoder leave of a difference of readings.
            of_wheel = self._quantum**2 / 6.0 / seconds**2
        linear, angular = 0.5 * of_wheel, 2.0 * of_wheel / self.drive.separation**2
        self._before = self._stamp_ns, odometry.distance, odometry.turn
        x, y, heading = odometry.pose
        xx, xy, xh, yy, yh, hh = odometry.covariance
        return (
            Pose((x, y, 0.0), (0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading))),
            _planar_covariance([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]]),
            Twist((twist.linear, 0.0, 0.0), (0.0, 0.0, twist.angular)),
            _planar_covariance(np.diag([linear, linear, angular])),
        )


def planar(pose: Pose) -> PlanarPose:
    """Return a pose in the plane: x, y and yaw in (-pi, pi]."""
    x, y, z, w = pose.orientation
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return PlanarPose(pose.position[0], pose.position[1], heading)


ODOM_FRAME = "odom"
UNMEASURED = 1e6
"""Variance of what wheels do not measure: height, roll, pitch and their rates."""


def true_odometry(world: World) -> OdometryValues:
    """Return how the root of a world's robot really is; it is certain."""
    certain = (0.0,) * 36
    return world.base_pose(), certain, world.base_velocity(), certain


def _planar_covariance(covariance: ArrayLike) -> list[float]:
    """Return the whole covariance, row by row, for that of x, y and yaw."""
    whole = UNMEASURED * np.eye(6)
    whole[np.ix_([0, 1, 5], [0, 1, 5])] = covariance
    numbers: list[float] = whole.ravel().tolist()
    return numbers


CLOCK_TOPIC, ODOM, TRUTH, SLIP = "clock", "odom", "base_pose_ground_truth", "wheel_slip"
REPORT_KINDS = {
    CLOCK_TOPIC: wire.CLOCK,
    ODOM: wire.ODOMETRY,
    TRUTH: wire.ODOMETRY,
    SLIP: wire.VECTOR,
    END_EFFECTOR: wire.POSE,
    BRICK_POSES: wire.POSES,
    GRIP_EVENTS: wire.STATUSES,
}
"""Type of each topic."""


def recorded_reports(settings: WorldSettings) -> tuple[str, ...]:
    """Return the topics that a recording of a run must have."""
    of_the_base = () if settings.base is None else (ODOM, TRUTH, SLIP)
    return (*of_the_base, *task_topics(settings))


class Reports:
    """The messages of one world.

    ``odom`` is what the wheels say where the robot has a base, else the truth. ``wheel_slip`` is
    how far the contacts have slid: x the left wheel, y the right wheel, z the axle sideways.
    ``ee_pose`` is the true pose of a link in the frame ``odom``.
    """

    def __init__(
        self,
        world: World,
        link: str,
        rate: float,
        end_ns: int | None,
        *,
        prefix: str = "",
        notice: Callable[[GripEvent], None] | None = None,
        wanted: Collection[str] | None = None,
    ) -> None:
        self._world, self._link = world, link
        self._times = ReportTimes(rate, end_ns)
        self._odom, self._root = prefix + ODOM_FRAME, prefix + world.description.root
        known = [CLOCK_TOPIC, ODOM, TRUTH, END_EFFECTOR] if self._times.period_ns else []
        if world.settings.base is not None and known:
            known.append(SLIP)
        if world.gripper is not None:
            known += [BRICK_POSES, GRIP_EVENTS] if known else [GRIP_EVENTS]
        self.topics = tuple(each for each in known if wanted is None or each in wanted)
        self.counts = dict.fromkeys(self.topics, 0)
        has_base = {ODOM, SLIP} & set(self.topics) and world.settings.base is not None
        self._monitor = BaseMonitor(world) if has_base else None
        self._reported = Slip(0.0, 0.0, 0.0)
        self._gripper: Gripper | None = None
        self._noticed = 0
        self._notice = notice

    def sample(self, stamp_ns: int, positions: Sequence[float]) -> Iterator[tuple[str, bytes]]:
        """Yield the topic and the bytes of each message that is due; once for each state."""
        yield from self.events()
        if self._monitor is not None:
            self._monitor.note(positions)
        if self._times.is_due(stamp_ns):
            for topic, encode in self._due(stamp_ns):
                yield from self._counted(topic, encode)

    def events(self) -> Iterator[tuple[str, bytes]]:
        """Yield topic and bytes of what the gripper did since the last call."""
        gripper = self._world.gripper
        if gripper is None:
            return
        if gripper is not self._gripper:  # a reset made a new one
            self._gripper, self._noticed = gripper, 0
        for event in gripper.events[self._noticed :]:
            self._noticed += 1
            if self._notice is not None:
                self._notice(event)
            yield from self._counted(GRIP_EVENTS, partial(wire.encode_status, grip_status(event)))

    def figures(self) -> dict[str, object]:
        """Return figures for ``/diagnostics``, with their units; slip also since the last call."""
        figures: dict[str, object] = {}
        if self._monitor is not None:
            slip, before = self._monitor.slip, self._reported
            self._reported = slip
            figures["driven by the wheels [m]"] = self._monitor.distance
            for name, now, then in zip(
                ("left wheel", "right wheel", "axle, sideways"), slip, before, strict=True
            ):
                figures[f"slip of the {name} [m]"] = now
                figures[f"slip of the {name}, recent [m]"] = max(now - then, 0.0)
        gripper = self._world.gripper
        if gripper is not None:
            held, last = gripper.held, gripper.events[-1:]
            figures["brick in the gripper"] = "none" if held is None else held.name
            figures["last grip"] = grip_words(last[0]) if last else "none"
        return figures

    def _counted(self, topic: str, encode: Callable[[], bytes]) -> Iterator[tuple[str, bytes]]:
        """Yield a message where somebody takes it, and count it."""
        if topic in self.counts:
            self.counts[topic] += 1
            yield topic, encode()

    def _due(self, stamp_ns: int) -> Iterator[tuple[str, Callable[[], bytes]]]:
        """Yield each topic that is published at a rate, and what makes its message."""
        world, header = self._world, wire.Stamp(stamp_ns, self._odom)
        yield CLOCK_TOPIC, partial(wire.encode_clock, stamp_ns)
        if self._monitor is None:
            yield ODOM, lambda: self._odometry(header, true_odometry(world))
        else:
            odometry = self._monitor.report()
            yield ODOM, lambda: self._odometry(header, odometry)
            of_root = header._replace(frame=self._root)
            yield SLIP, partial(wire.encode_vector, of_root, self._monitor.slip)
        yield TRUTH, lambda: self._odometry(header, true_odometry(world))
        yield END_EFFECTOR, lambda: wire.encode_pose(header, world.link_pose(self._link))
        gripper = world.gripper
        if gripper is not None:
            yield BRICK_POSES, lambda: wire.encode_poses(header, gripper.poses())

    def _odometry(self, header: wire.Stamp, values: OdometryValues) -> bytes:
        return wire.encode_odometry(header, self._root, *values)


def grip_words(event: GripEvent) -> str:
    reason = f": {event.reason}" if event.reason else ""
    return f"{event.brick} {event.outcome} at {event.stamp_ns / NANOSECONDS:.3f} s{reason}"
