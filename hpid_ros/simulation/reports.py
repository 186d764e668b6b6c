"""Reports of a simulated robot beside its joint states, as serialised messages.

The bridge publishes them and a run in one process writes them into its bag: the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages import reports as wire
from hpid_ros.simulation.base import (
    ODOM_FRAME,
    BaseMonitor,
    OdometryValues,
    ReportTimes,
    Slip,
    true_odometry,
    wheel_odometry,
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
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

CLOCK, ODOM, TRUTH, SLIP = "clock", "odom", "base_pose_ground_truth", "wheel_slip"
KINDS = {
    CLOCK: wire.CLOCK,
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
        prefix: str = "",
        notice: Callable[[GripEvent], None] | None = None,
        wanted: Collection[str] | None = None,
    ) -> None:
        self._world, self._link = world, link
        self._times = ReportTimes(rate, end_ns)
        self._odom, self._root = prefix + ODOM_FRAME, prefix + world.description.root
        known = [] if self._times.is_off else [CLOCK, ODOM, TRUTH, END_EFFECTOR]
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
        if not self._times.is_off and self._times.is_due(stamp_ns):
            for topic, encode in self._due(stamp_ns):
                yield from self._told(topic, encode)

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
            yield from self._told(GRIP_EVENTS, partial(_encoded, event))

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

    def _told(self, topic: str, encode: Callable[[], bytes]) -> Iterator[tuple[str, bytes]]:
        """Yield a message where somebody takes it, and count it."""
        if topic in self.counts:
            self.counts[topic] += 1
            yield topic, encode()

    def _due(self, stamp_ns: int) -> Iterator[tuple[str, Callable[[], bytes]]]:
        """Yield each topic that is told at a rate, and what makes its message."""
        world, header = self._world, wire.Stamp(stamp_ns, self._odom)
        yield CLOCK, partial(wire.encode_clock, stamp_ns)
        if self._monitor is None:
            yield ODOM, lambda: self._odometry(header, true_odometry(world))
        else:
            report = self._monitor.report()
            yield ODOM, lambda: self._odometry(header, wheel_odometry(report))
            of_root = header._replace(frame=self._root)
            yield SLIP, partial(wire.encode_vector, of_root, report.slip)
        yield TRUTH, lambda: self._odometry(header, true_odometry(world))
        yield END_EFFECTOR, lambda: wire.encode_pose(header, world.link_pose(self._link))
        gripper = world.gripper
        if gripper is not None:
            yield BRICK_POSES, lambda: wire.encode_poses(header, gripper.poses())

    def _odometry(self, header: wire.Stamp, values: OdometryValues) -> bytes:
        return wire.encode_odometry(
            header,
            self._root,
            values.pose,
            values.pose_covariance,
            values.twist,
            values.twist_covariance,
        )


def _encoded(event: GripEvent) -> bytes:
    return wire.encode_status(grip_status(event))


def grip_words(event: GripEvent) -> str:
    """Return an event in words."""
    reason = f": {event.reason}" if event.reason else ""
    return f"{event.brick} {event.outcome} at {event.stamp_ns / NANOSECONDS:.3f} s{reason}"
