"""A robot in PyBullet."""
