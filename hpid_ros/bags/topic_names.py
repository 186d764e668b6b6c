"""Finding topics by name, by the parts of their names, and by type."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from hpid_ros.errors import BagError, unknown_name

_CONTROLLER = "_controller"


def find_topic(where: str, name: str, types: Mapping[str, str], allowed: Collection[str]) -> str:
    """Return the full name of a topic.

    Args:
        where: The bag, for errors.
        name: With a leading slash the full name; without one also its last parts, so that
            ``joint_states`` finds ``/arm/joint_states``.
        types: Types of all topics by full name.
        allowed: Types that it may have.

    Raises:
        BagError: If there is no such topic, if there are several, or it has another type.
    """
    found = matching(name, types)
    if not found:
        raise BagError(f"{where}: {unknown_name('topic', name, types)}")
    if len(found) > 1:
        raise BagError(f"{where}: topic {name!r} could be any of {', '.join(found)}")
    (topic,) = found
    if types[topic] not in allowed:
        raise BagError(
            f"{where}: topic {topic} is {types[topic]}, but must be {' or '.join(allowed)}"
        )
    return topic


def matching(name: str, topics: Collection[str]) -> list[str]:
    """Return the topics that a name can mean, in order: one if it is a full name."""
    bare = name.lstrip("/")
    found = [topic for topic in topics if topic.lstrip("/") == bare]
    if not found and not name.startswith("/"):
        found = [topic for topic in topics if topic.endswith(f"/{bare}")]
    return sorted(found)


def namespace_of(topic: str) -> str:
    """Return the part before the last slash: ``/left`` for ``/left/joint_states``."""
    return topic.rpartition("/")[0]


def last_part(topic: str) -> str:
    """Return the part after the last slash."""
    return topic.rpartition("/")[2]


def is_below(topic: str, namespace: str) -> bool:
    """Tell whether a topic is in a namespace or in one below it."""
    return topic.startswith(f"{namespace.rstrip('/')}/")


def joint_of(topic: str) -> str:
    """Return the joint of a controller's own topic: ``elbow`` of ``/elbow_controller/command``."""
    return last_part(namespace_of(topic)).removesuffix(_CONTROLLER)
