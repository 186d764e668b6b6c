"""Makes ``rclpy.experimental`` unavailable, as in an rclpy that has no EventsExecutor."""

import sys

sys.modules["rclpy.experimental"] = None  # type: ignore[assignment]
