"""Columns of numbers out of the storages of rosbag2."""
