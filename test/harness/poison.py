"""Messages that claim what they do not hold, or once cost far more than they are."""

import struct
from pathlib import Path

from hpid_ros.messages.joint_state import JointStateTemplate, Writer


def head(names, stamp_ns=0):
    """Return the beginning of a message about joints: its header, and their names."""
    writer = Writer()
    writer.time(stamp_ns)
    writer.string("")
    writer.scalar("I", len(names))
    for name in names:
        writer.string(name)
    return writer.raw


def without_numbers(points, names, first=()):
    """Return a trajectory of empty names and of points without a number: small, many of both."""
    begin = head(first)
    at = begin.rindex(struct.pack("<I", len(first))) if not first else 16
    text = bytearray(begin) + bytes(-len(begin) % 4) + bytes(4 * names)
    text[at : at + 4] = struct.pack("<I", len(first) + names)
    return bytes(text) + struct.pack("<I", points) + bytes(24 * points)


def with_bytes(raw, old, new):
    """Return a message with some of its bytes replaced, which are as many."""
    assert raw.count(old) == 1
    return raw.replace(old, new)


def not_utf8(joint):
    """Return a state whose joint's name is no text."""
    state = JointStateTemplate([joint], position=True).encode(0, position=[0.0])
    return with_bytes(state, joint.encode(), b"\xff" * len(joint))


def trajectories(joint):
    """Return by what they are trajectories that name a joint and are refused, or are none."""
    good = head([joint])
    return {
        "points and names without numbers": without_numbers(50_000, 100_000, [joint]),
        "more names than are taken": without_numbers(50_000, 10_000, [joint]),
        "points without numbers": without_numbers(50_000, 0, [joint]),
        "a count that nothing holds": good + b"\0" * (-len(good) % 4) + b"\xff" * 4,
        "names that nothing holds": head([])[:-4] + b"\xff" * 4 + bytes(100),
        "names that are no text": with_bytes(
            without_numbers(1, 0, [joint]), joint.encode(), b"\xff" * len(joint)
        ),
        "a name of a megabyte": without_numbers(1, 0, [joint, "x" * 1_000_000]),
        "no bytes of a message": b"\x07" * 100,
    }


def states(joint):
    """Return by what they are states that name a joint and are refused, or are none."""
    many = head([joint] * 100_000)
    return {
        "a joint a hundred thousand times": many + bytes(-len(many) % 4 + 12),
        "numbers that nothing holds": head([joint]) + b"\0\0\0\0" + b"\xff" * 12,
        "a name that is no text": not_utf8(joint),
        "a name of a megabyte": head([joint, "x" * 1_000_000]) + bytes(15),
        "no bytes of a message": b"\x07" * 100,
    }


def memory_of(pid, what="VmHWM"):
    """Return the most memory that a process has had in [MiB]; ``VmRSS`` is what it has."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith(f"{what}:")).split()[1]) / 1024
