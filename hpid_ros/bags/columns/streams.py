"""One number of each joint, collected from all messages of a topic without an object for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from hpid_ros.bags.columns.batches import WORD, Integers, TopicBatch, Words, gather_words
from hpid_ros.bags.columns.layouts import ENCAPSULATION, LAYOUTS, Layout
from hpid_ros.bags.columns.samples import (
    DeltaColumn,
    JointSamples,
    LayoutFamily,
    Mask,
    NumberColumn,
    merged,
)
from hpid_ros.base.errors import MessageError


class OrderNeededError(Exception):
    """The order of messages matters, but was not kept: read again, and keep it."""


class _Group:
    """Messages that carry numbers of the same joints."""

    def __init__(self, joints: tuple[str, ...], has_stamps: bool, has_order: bool) -> None:
        self._stamps = DeltaColumn(np.uint32) if has_stamps else None
        self._log_times = DeltaColumn(np.uint32) if has_order else None
        self._places = DeltaColumn(np.uint16) if has_order else None
        self._last_place = -1
        self.is_in_order = True
        self.values = {joint: NumberColumn() for joint in joints}

    def append(
        self, layout: Layout, rows: Words, which: Integers | slice, batch: TopicBatch
    ) -> None:
        places = batch.places[which]
        if places[0] < self._last_place:
            self.is_in_order = False  # two layouts by turns
        self._last_place = max(self._last_place, int(places[-1]))
        if self._stamps is not None:
            self._stamps.append(layout.stamps_ns(rows, which))
        if self._log_times is not None and self._places is not None:
            self._log_times.append(batch.log_times_ns[which])
            self._places.append(places)

    @cached_property
    def clock(self) -> tuple[Integers | None, Integers | None, Integers | None]:
        """Stamps, log times and places, shared by all joints of the group."""
        stamps, log_times, places = (
            None if column is None else column.numbers()
            for column in (self._stamps, self._log_times, self._places)
        )
        return stamps, log_times, places


class JointStream:
    """Collects one field of a topic's messages by joint."""

    def __init__(
        self,
        type: str,
        field: str,
        joints: frozenset[str] | None = None,
        elements: Mapping[int, str] | None = None,
        keeps_order: bool = True,
    ) -> None:
        self._learn: Callable[[bytes], Layout] = LAYOUTS[type]
        self._field = field
        self._joints = joints
        self._elements = elements
        self._keeps_order = keeps_order
        self._families: dict[int, list[LayoutFamily]] = {}
        self._groups: dict[tuple[str, ...], _Group] = {}
        self._groups_of: dict[str, list[tuple[str, ...]]] = {}
        self._last_log_time_ns = -(2**63)
        self._is_log_ordered = True
        self._columns_of: WeakKeyDictionary[Layout, Mapping[str, int]] = WeakKeyDictionary()
        self.names: dict[str, None] = {}
        self.message_count = 0
        self.undecodable = 0
        self.first_failure = ""

    def add(self, batch: TopicBatch) -> None:
        """Take the next messages of the topic."""
        self.message_count += len(batch.starts)
        times = batch.log_times_ns
        if times[0] < self._last_log_time_ns or (times[1:] < times[:-1]).any():
            self._is_log_ordered = False
            if not self._keeps_order:
                raise OrderNeededError
        self._last_log_time_ns = max(self._last_log_time_ns, int(times[-1]))
        sizes = batch.sizes
        left = sizes
        while len(left):
            size = int(left[0])
            is_size = sizes == size
            if is_size.all():
                self._add_size(batch, size)
                return
            self._add_size(TopicBatch(batch.topic, batch.buffer, *_picked(batch, is_size)), size)
            left = left[left != size]

    def joints(self) -> frozenset[str]:
        """Return the joints that have numbers."""
        return frozenset(self._groups_of)

    def take(self, joint: str) -> JointSamples | None:
        """Return one joint's samples and forget them; None if there are none."""
        parts, is_in_order = [], self._is_log_ordered
        for joints in self._groups_of.pop(joint, ()):
            group = self._groups[joints]
            parts.append(JointSamples(*group.clock, group.values.pop(joint).finished()))
            is_in_order &= group.is_in_order
            if not group.values:
                del self._groups[joints]
        if not parts:
            return None
        if len(parts) == 1 and is_in_order:
            return parts[0]
        samples = merged(parts)
        if samples.places is None or samples.log_times_ns is None:
            raise OrderNeededError
        return samples.picked(np.lexsort((samples.places, samples.log_times_ns)))

    def _add_size(self, batch: TopicBatch, size: int) -> None:
        """Take messages of one length."""
        words = -(-(size + ENCAPSULATION) // WORD)
        rows = gather_words(batch.buffer, batch.starts - ENCAPSULATION, words)
        families = self._families.setdefault(size, [])
        is_left = np.ones(len(rows), dtype=np.bool_)
        for family in families:
            for layout, claims in family.split(rows):
                self._keep(layout, rows, np.flatnonzero(claims), batch)
                is_left &= ~claims
        while is_left.any():
            left = np.flatnonzero(is_left)
            first = self._learned(batch, int(left[0]))
            if first is None:
                is_left[left[0]] = False
                continue
            for which in _equal_rows(rows[left] & first.mask):
                here = left[which]
                own = first if here[0] == left[0] else self._learned(batch, int(here[0]))
                if own is None or not np.array_equal(own.mask, first.mask):
                    here = here[:1]  # the others may differ from it where the first's mask is zero
                is_left[here] = False
                if own is not None:
                    _remember(own, families)
                    self._keep(own, rows, here, batch)

    def _learned(self, batch: TopicBatch, index: int) -> Layout | None:
        """Return the layout of one message; None if it is not of the type."""
        try:
            return self._learn(batch.raw(index))
        except MessageError as error:
            self.undecodable += 1
            self.first_failure = self.first_failure or str(error)
            return None

    def _keep(self, layout: Layout, rows: Words, which: Integers, batch: TopicBatch) -> None:
        """Append the numbers of messages of one layout to their group."""
        columns = self._columns(layout)
        if not columns:
            return
        joints = tuple(columns)
        group = self._groups.get(joints)
        if group is None:
            if not self._keeps_order and any(joint in self._groups_of for joint in joints):
                raise OrderNeededError
            group = _Group(joints, layout.stamp is not None, self._keeps_order)
            self._groups[joints] = group
            for joint in joints:
                self._groups_of.setdefault(joint, []).append(joints)
        picked: Integers | slice = slice(None) if len(which) == len(rows) else which
        group.append(layout, rows, picked, batch)
        if not (group.is_in_order or self._keeps_order):
            raise OrderNeededError
        for joint, index in columns.items():
            group.values[joint].append(layout.column(rows, self._field, index)[picked])

    def _columns(self, layout: Layout) -> Mapping[str, int]:
        """Return which wanted joint is at which place of the field."""
        columns = self._columns_of.get(layout)
        if columns is None:
            columns = self._columns_of[layout] = self._find_columns(layout)
        return columns

    def _find_columns(self, layout: Layout) -> Mapping[str, int]:
        length = layout.fields[self._field].length if self._field in layout.fields else 0
        if self._elements is not None:
            return {j: element for element, j in self._elements.items() if element < length}
        self.names.update(dict.fromkeys(layout.names))
        if length != len(layout.names):
            return {}  # the wire allows arrays of another length than the names
        wanted = self._joints
        columns: dict[str, int] = {}
        for index, name in enumerate(layout.names):
            if wanted is None or name in wanted:
                columns.setdefault(name, index)
        return columns


def _remember(layout: Layout, families: list[LayoutFamily]) -> None:
    for family in families:
        if family.accepts(layout):
            family.add(layout)
            return
    families.append(LayoutFamily(layout))


def _equal_rows(rows: Words) -> list[Integers]:
    """Return which rows are equal to each other, the first one's first."""
    is_first = (rows == rows[0]).all(axis=1)
    if is_first.all():
        return [np.flatnonzero(is_first)]
    order = np.lexsort(rows.T)
    is_new = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    groups = np.split(order, np.flatnonzero(is_new) + 1)
    return sorted(groups, key=lambda group: int(group[0]))


def _picked(batch: TopicBatch, which: Mask) -> Iterator[Integers]:
    return (part[which] for part in (batch[2], batch[3], batch[4], batch[5]))
