"""Motions that make joints tell what they are, within their limits; without ROS."""
