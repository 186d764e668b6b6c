"""What rosbags keeps to itself: how a reader of ROS 1 unpacks its chunks, to any size.

``chunks`` of ``rosbags.rosbag1.Reader`` and ``decompressors`` of its module were read in rosbags
0.11.0 and 0.11.9, where they are the same; no other module of this package touches them
(``test_architecture.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rosbags.rosbag1.reader import decompressors


def bound_chunks(reader: Any, unpack: Callable[[str, bytes], bytes]) -> None:
    """Have an open reader of ROS 1 unpack its chunks by a function of compression and bytes."""
    kinds = {function: kind for kind, function in decompressors.items()}
    for place, chunk in reader.chunks.items():
        kind = kinds.get(chunk.decompressor, "none")
        if kind != "none":
            reader.chunks[place] = chunk._replace(decompressor=partial(unpack, kind))
