"""Bags as rosbags reads them: a reader that is not the package's."""

from typing import NamedTuple

from rosbags.rosbag2 import Reader


class Message(NamedTuple):
    topic: str
    log_time_ns: int
    raw: bytes


class BagReader(Reader):
    def messages(self):
        for connection, log_time_ns, raw in super().messages():
            yield Message(connection.topic, log_time_ns, bytes(raw))
