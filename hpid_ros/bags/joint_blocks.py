"""Many raw JointStates as few arrays, without a message object for each.

A publisher repeats one layout, so that nearly all messages of a topic differ in their stamp and
doubles only. Messages of one layout are joined and viewed as arrays; what has no fixed layout
(other byte order, odd padding) takes the general decoder.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.errors import MessageError
from hpid_ros.messages.joint_state import (
    STAMP_OFFSET,
    JointStateFields,
    JointStateLayout,
    decode_joint_state,
)

Times = NDArray[np.int64]
Numbers = NDArray[np.float64]

_NS_PER_S = 1_000_000_000
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_LAYOUTS_PER_SIZE = 64
"""Passes over messages of one size before the rest is decoded one by one."""


class JointStateBlock(NamedTuple):
    """JointStates with the same names, as arrays over n messages and k joints.

    Attributes:
        names: Joint names, in the order of the columns.
        order: Place of each message among all that were given, shape (n,).
        stamps_ns: Header stamps, in [ns], shape (n,).
        position: In [rad] or [m], shape (n, k), or (n, 0) if the messages carry none.
        effort: In [N m] or [N], shape (n, k), or (n, 0) if the messages carry none.
    """

    names: tuple[str, ...]
    order: Times
    stamps_ns: Times
    position: Numbers
    effort: Numbers


class JointColumn(NamedTuple):
    """One joint's numbers in the order of the messages that carry it.

    Attributes:
        order: Place of each message among all, ascending, shape (n,).
        stamps_ns: Header stamps, in [ns], shape (n,).
        values: Positions or efforts, shape (n,).
    """

    order: Times
    stamps_ns: Times
    values: Numbers

    def by_stamp(self) -> tuple[Times, Numbers, int]:
        """Return ascending stamps, their values, and how many repeated stamps were dropped.

        Of several messages with the same stamp the last stands.
        """
        by_stamp = np.argsort(self.stamps_ns, kind="stable")
        stamps = self.stamps_ns[by_stamp]
        is_last = np.ones(len(stamps), dtype=bool)
        is_last[:-1] = stamps[1:] != stamps[:-1]
        kept = by_stamp[is_last]
        return stamps[is_last], self.values[kept], len(stamps) - len(kept)


def joint_state_blocks(raws: Sequence[bytes]) -> list[JointStateBlock]:
    """Turn serialised JointStates into arrays.

    Args:
        raws: The messages, each with its encapsulation header.

    Returns:
        One block for each layout; every message is in exactly one.

    Raises:
        MessageError: A message is no JointState.
    """
    by_size: defaultdict[int, list[int]] = defaultdict(list)
    for index, raw in enumerate(raws):
        by_size[len(raw)].append(index)
    blocks: list[JointStateBlock] = []
    for size, indices in by_size.items():
        blocks.extend(_blocks_of_size(raws, size, np.array(indices, dtype=np.int64)))
    return blocks


def joint_column(blocks: Iterable[JointStateBlock], joint: str, field: str) -> JointColumn:
    """Collect one joint's numbers from all blocks that carry them.

    Args:
        blocks: What :func:`joint_state_blocks` returned.
        joint: The joint.
        field: ``"position"`` or ``"effort"``.

    Returns:
        Its column; empty if no message carries that number.
    """
    orders, stamps, values = [], [], []
    for block in blocks:
        numbers: Numbers = getattr(block, field)
        if joint in block.names and numbers.shape[1]:
            orders.append(block.order)
            stamps.append(block.stamps_ns)
            values.append(numbers[:, block.names.index(joint)])
    if not orders:
        return JointColumn(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
    order = np.concatenate(orders)
    by_order = np.argsort(order)
    return JointColumn(
        order[by_order], np.concatenate(stamps)[by_order], np.concatenate(values)[by_order]
    )


def _blocks_of_size(raws: Sequence[bytes], size: int, indices: Times) -> Iterator[JointStateBlock]:
    """Yield the blocks of messages that are all ``size`` bytes long."""
    table = np.frombuffer(b"".join([raws[i] for i in indices]), dtype=np.uint8)
    table = table.reshape(len(indices), size)
    odd: list[int] = []
    for _ in range(_LAYOUTS_PER_SIZE):
        if not len(indices):
            break
        layout = _layout_or_none(raws[indices[0]])
        if layout is None:
            odd.append(int(indices[0]))
            indices, table = indices[1:], table[1:]
            continue
        is_alike = _rows_alike(table, layout)
        yield _block(table[is_alike], layout, indices[is_alike])
        indices, table = indices[~is_alike], table[~is_alike]
    odd.extend(indices.tolist())
    yield from _decoded_blocks(raws, odd)


def _layout_or_none(raw: bytes) -> JointStateLayout | None:
    try:
        return JointStateLayout.of(raw)
    except MessageError:
        return None


def _rows_alike(table: NDArray[np.uint8], layout: JointStateLayout) -> NDArray[np.bool_]:
    """Tell which messages have this layout; the vector form of ``JointStateLayout.matches``."""
    is_alike = np.ones(len(table), dtype=np.bool_)
    for offset, segment in ((0, _LITTLE_ENDIAN), *layout.fixed):
        # Compared as one opaque item a row, which is one memcmp instead of a loop over bytes.
        items = _column(table, offset, 1, f"V{len(segment)}")[:, 0]
        is_alike &= items == np.void(segment)
    return is_alike


def _block(table: NDArray[np.uint8], layout: JointStateLayout, order: Times) -> JointStateBlock:
    """View the messages of one layout as arrays."""
    positions, _, efforts = layout.lengths
    seconds = _column(table, STAMP_OFFSET, 1, "<i4")[:, 0].astype(np.int64)
    nanoseconds = _column(table, STAMP_OFFSET + 4, 1, "<u4")[:, 0].astype(np.int64)
    return JointStateBlock(
        layout.names,
        order,
        seconds * _NS_PER_S + nanoseconds,
        _numbers(_column(table, layout.position, positions, "<f8"), layout.names),
        _numbers(_column(table, layout.effort, efforts, "<f8"), layout.names),
    )


def _column(table: NDArray[np.uint8], offset: int, count: int, kind: str) -> NDArray[Any]:
    """View ``count`` items at ``offset`` of each row, which need not be aligned."""
    rows = np.ascontiguousarray(table)
    strides = (table.shape[1], np.dtype(kind).itemsize)
    view: NDArray[Any] = np.ndarray((len(table), count), kind, rows, offset, strides)
    return view


def _decoded_blocks(raws: Sequence[bytes], indices: Sequence[int]) -> Iterator[JointStateBlock]:
    """Decode messages one by one and collect those with the same names and lengths."""
    groups: defaultdict[object, list[tuple[int, JointStateFields]]] = defaultdict(list)
    for index in indices:
        fields = decode_joint_state(raws[index])
        groups[fields.names, len(fields.position), len(fields.effort)].append((index, fields))
    for group in groups.values():
        names = group[0][1].names
        yield JointStateBlock(
            names,
            np.array([index for index, _ in group], dtype=np.int64),
            np.array([fields.stamp_ns for _, fields in group], dtype=np.int64),
            _numbers(np.array([fields.position for _, fields in group]), names),
            _numbers(np.array([fields.effort for _, fields in group]), names),
        )


def _numbers(values: NDArray[Any], names: Sequence[str]) -> Numbers:
    """Return one number for each name, or none: the wire allows arrays of another length."""
    if values.shape[1] != len(names):
        values = values[:, :0]
    return np.ascontiguousarray(values, dtype=np.float64)
