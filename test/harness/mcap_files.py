"""MCAP files by the format's own library."""

from pathlib import Path

from mcap.writer import Writer

TYPES = {
    "joint_states": "sensor_msgs/msg/JointState",
    "joint_commands": "sensor_msgs/msg/JointState",
    "joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
}


def write_mcap(path: Path, log, *, end: bool = True, **options) -> Path:
    """Write ``(topic, log time, raw)``; without the end as after a recorder that was killed."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, **options)
        writer.start("ros2", "test")
        schemas = {
            kind: writer.register_schema(kind, "ros2msg", b"float64 x")
            for kind in sorted(set(TYPES.values()))
        }
        channels = {
            name: writer.register_channel(f"/{name}", "cdr", schemas[kind])
            for name, kind in TYPES.items()
        }
        for name, log_time_ns, raw in log:
            writer.add_message(channels[name], log_time_ns, raw, log_time_ns)
        if end:
            writer.finish()
    return path
