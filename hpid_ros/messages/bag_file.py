"""Opening a bag, its topics and its raw messages; all errors of a bad file become one line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

from hpid_ros.base.errors import BagError, unknown_name

if TYPE_CHECKING:
    from typing_extensions import Self


_LONGEST_REASON = 200
"""Characters of a foreign error's text that are shown."""


class TopicSummary(NamedTuple):
    """What a bag says about a topic."""

    type: str  # message type, for instance "sensor_msgs/msg/JointState"
    message_count: int  # number of messages


class RawMessage(NamedTuple):
    """One recorded message."""

    topic: str  # the topic's full name
    log_time_ns: int  # [ns] when it was recorded
    raw: bytes  # the serialised message


class BagReader:
    """An open bag: a folder with ``metadata.yaml``, or one ``.mcap`` or ``.db3`` file.

    Closed by the ``with`` block or :meth:`close`. It is rosbags that reads and unpacks, and that
    has no limits: for bags of strangers take :func:`hpid_ros.messages.run.read_run`.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise BagError(f"no bag at {self.path}: no such file or folder")
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            raise BagError(
                f"no bag at {self.path}: the folder has no metadata.yaml "
                "(a recording that was cut off has none either)"
            )
        from rosbags.rosbag2 import Reader

        try:
            self._reader = Reader(self.path)
            self._reader.open()
        # A damaged file lets anything escape from rosbags, down to struct and Unicode errors.
        except Exception as error:
            raise self._unreadable(error) from error
        connections: Sequence[Any] = self._reader.connections  # the names come from a YAML file
        for topic in connections:
            if not (isinstance(topic.topic, str) and isinstance(topic.msgtype, str)):
                self.close()
                raise BagError(f"cannot read bag {self.path}: a topic has no proper name or type")

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """The topics by full name."""
        topics: dict[str, TopicSummary] = {}
        for connection in self._reader.connections:
            before = topics.get(connection.topic)
            count = connection.msgcount + (before.message_count if before else 0)
            topics[connection.topic] = TopicSummary(connection.msgtype, count)
        return topics

    @property
    def metadata(self) -> Mapping[str, str]:
        """The texts that the recording was given; empty for a single file."""
        from hpid_ros.messages.rosbags_internals import custom_data

        return custom_data(self._reader)

    def find_topic(self, name: str, type: str) -> str:
        """Return the full name of a topic."""
        topics = self.topics
        bare = name.lstrip("/")
        found = [topic for topic in topics if topic.lstrip("/") == bare]
        if not found and not name.startswith("/"):
            found = [topic for topic in topics if topic.endswith(f"/{bare}")]
        if not found:
            raise BagError(f"bag {self.path}: {unknown_name('topic', name, topics)}")
        if len(found) > 1:
            raise BagError(
                f"bag {self.path}: topic {name!r} could be any of {', '.join(sorted(found))}"
            )
        (topic,) = found
        if topics[topic].type != type:
            raise BagError(
                f"bag {self.path}: topic {topic} is {topics[topic].type}, but must be {type}"
            )
        return topic

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order of the log."""
        connections = [
            connection
            for connection in self._reader.connections
            if not topics or connection.topic in topics
        ]
        if not connections:
            return
        missing = sum(connection.msgcount for connection in connections)
        try:
            for connection, log_time_ns, raw in self._reader.messages(connections):
                missing -= 1
                yield RawMessage(connection.topic, log_time_ns, raw)
        # As in the constructor; what the caller raises between two messages does not come here.
        except Exception as error:
            raise self._unreadable(error) from error
        if missing:
            raise BagError(
                f"cannot read bag {self.path}: its index counts {missing:+d} messages on "
                f"{', '.join(topics) or 'all topics'} against those in the file"
            )

    def close(self) -> None:
        """Close the files; does nothing the second time."""
        if self._reader.is_open:
            with suppress(OSError):
                self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _unreadable(self, error: Exception) -> BagError:
        reason = " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__
        return BagError(f"cannot read bag {self.path}: damaged or no bag ({reason})")
