"""The reference of a recorded run: its trajectories, sampled where the states are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hpid_ros.bags.joint_blocks import JointColumn, Numbers, Times
from hpid_ros.trajectory import JointTrajectory, ReferenceSample, SplineReference


class LoggedTrajectory(NamedTuple):
    """A trajectory and its place in the log.

    Attributes:
        trajectory: What was published.
        states_before: How many messages of the state topic the bag holds before it.
    """

    trajectory: JointTrajectory
    states_before: int


class _Span(NamedTuple):
    """A reference and the index of the first state that it holds for."""

    begin: int
    reference: SplineReference


def sample_reference(
    joint: str,
    trajectories: Iterable[LoggedTrajectory],
    states: JointColumn,
    stamps_ns: Times,
    first_position: float,
) -> Numbers:
    """Sample what a joint was to follow at each of its states.

    As in :class:`hpid_ros.control.JointLoop`, a trajectory takes over with the next state (the
    first that was logged after it) from where the reference stood at the state before, also when
    its stamp lies ahead. A stamp earlier than that state moves the take-over back to the stamp:
    a recorder that started late got the latched message later than the controllers. A later
    message supersedes an earlier one. Before any trajectory the joint holds its first position.
    Trajectories without the joint do not concern it.

    Args:
        joint: The joint.
        trajectories: In the order of the log.
        states: The joint's states in the order of the log.
        stamps_ns: The stamps to sample at, strictly increasing, shape (n,), in [ns].
        first_position: The joint's first position, in [rad].

    Returns:
        The reference, shape (n,), in [rad].
    """
    spans: list[_Span] = []
    for logged in trajectories:
        if joint not in logged.trajectory.joint_names:
            continue
        begin = _first_state(logged, states, stamps_ns)
        if begin == len(stamps_ns):
            continue
        while spans and spans[-1].begin >= begin:
            spans.pop()
        before = ReferenceSample(first_position, 0.0, 0.0)
        if spans:
            before = spans[-1].reference.sample(int(stamps_ns[begin - 1]))
        column = logged.trajectory.column(joint)
        now_ns = int(stamps_ns[begin])
        spans.append(_Span(begin, column.start(now_ns, before.position, before.velocity)))
    return _sampled(spans, stamps_ns, first_position)


def _first_state(logged: LoggedTrajectory, states: JointColumn, stamps_ns: Times) -> int:
    """Return the index of the first state under a trajectory; the length if there is none."""
    begin = len(stamps_ns)
    following = int(np.searchsorted(states.order, logged.states_before))
    if following < len(states.order):
        begin = int(np.searchsorted(stamps_ns, states.stamps_ns[following]))
    if logged.trajectory.stamp_ns:
        begin = min(begin, int(np.searchsorted(stamps_ns, logged.trajectory.stamp_ns)))
    return begin


def _sampled(spans: list[_Span], stamps_ns: Times, hold: float) -> Numbers:
    """Sample each reference over its own states, and hold before the first."""
    reference = np.full(len(stamps_ns), hold)
    end = len(stamps_ns)
    for begin, motion in reversed(spans):
        reference[begin:end] = [
            motion.sample(stamp_ns).position for stamp_ns in stamps_ns[begin:end].tolist()
        ]
        end = begin
    return reference
