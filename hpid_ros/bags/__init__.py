"""Bags: written as the bytes came, read as arrays. The only importer of rosbags."""

from hpid_ros.bags.bag_file import BagReader, RawMessage, TopicSummary
from hpid_ros.bags.run.reader import read_run
from hpid_ros.bags.selection import BagSelection, CommandTopic, parse_command_topics
from hpid_ros.bags.writer import BagTopic, BagWriter, TopicQos

__all__ = [
    "BagReader",
    "BagSelection",
    "BagTopic",
    "BagWriter",
    "CommandTopic",
    "RawMessage",
    "TopicQos",
    "TopicSummary",
    "parse_command_topics",
    "read_run",
]
