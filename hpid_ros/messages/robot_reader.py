"""Reads all joints of a model from serialised JointStates, at fixed offsets."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import NamedTuple

from hpid_ros.errors import MessageError
from hpid_ros.messages.joint_state import JointStateFields, JointStateLayout, decode_joint_state

_DOUBLE = 8
_Pick = Callable[[Sequence[float]], Sequence[float]]


class RobotSample(NamedTuple):
    """Several joints' part of a JointState, in the order that was asked for.

    Attributes:
        position: In [rad] or [m].
        velocity: In [rad/s] or [m/s]; None when the message has no velocities.
        effort: In [N m] or [N]; None when the message has no efforts.
    """

    position: Sequence[float]
    velocity: Sequence[float] | None
    effort: Sequence[float] | None


class RobotReader:
    """Finds several joints' numbers in serialised JointStates.

    As in :class:`~hpid_ros.messages.readers.JointReader`, the offsets are learned and used as
    long as the layout stays.

    Args:
        joints: The joints to look for, at least one.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self._layout: JointStateLayout | None = None
        self._numbers = struct.Struct("")
        self._picks: tuple[_Pick | None, ...] = ()

    def read(self, raw: bytes) -> RobotSample:
        """Return the joints' sample.

        Raises:
            MessageError: The bytes are no JointState, it lacks one of the joints or names one
                twice, or an array has another length than the names.
        """
        layout = self._layout
        if layout is None or not layout.matches(raw):
            return self._learn(raw)
        numbers = self._numbers.unpack_from(raw, layout.position)
        positions, velocities, efforts = self._picks
        return RobotSample(
            positions(numbers),  # type: ignore[misc]
            None if velocities is None else velocities(numbers),
            None if efforts is None else efforts(numbers),
        )

    def _learn(self, raw: bytes) -> RobotSample:
        fields = decode_joint_state(raw)
        count = len(fields.names)
        for joint in self.joints:
            if fields.names.count(joint) != 1:
                raise MessageError(
                    f"a JointState must name each joint of the model once, "
                    f"not {joint!r} {fields.names.count(joint)} times"
                )
        arrays = (fields.position, fields.velocity, fields.effort)
        lengths = tuple(len(array) for array in arrays)
        if lengths[0] != count or not {lengths[1], lengths[2]} <= {0, count}:
            raise MessageError(
                f"a JointState of {count} names must have {count} positions and 0 or {count} "
                f"velocities and efforts, not {lengths[0]}, {lengths[1]} and {lengths[2]}"
            )
        indices = [fields.names.index(joint) for joint in self.joints]
        self._remember(raw, fields, indices)
        found = [tuple(array[k] for k in indices) if array else None for array in arrays]
        return RobotSample(found[0] or (), found[1], found[2])

    def _remember(self, raw: bytes, fields: JointStateFields, indices: Sequence[int]) -> None:
        lengths = len(fields.position), len(fields.velocity), len(fields.effort)
        layout = JointStateLayout.for_fields(fields.names, fields.frame_id, lengths)
        if not layout.matches(raw):  # big-endian or oddly padded: not at fixed offsets
            self._layout = None
            return
        numbers, at, first = "<", layout.position, 0
        picks: list[_Pick | None] = []
        for start, length in zip(
            (layout.position, layout.velocity, layout.effort), lengths, strict=True
        ):
            if not length:
                picks.append(None)
                continue
            numbers += f"{start - at}x{length}d"
            at = start + _DOUBLE * length
            picks.append(_picking([first + index for index in indices]))
            first += length
        self._numbers = struct.Struct(numbers)
        self._picks = tuple(picks)
        self._layout = layout


def _picking(places: Sequence[int]) -> _Pick:
    """Return what takes the numbers at some places."""
    if list(places) == list(range(places[0], places[0] + len(places))):
        return itemgetter(slice(places[0], places[0] + len(places)))
    return itemgetter(*places)
