"""Animations of recorded runs: the robot as it moved, and below it what is judged."""

from hpid_ros.rendering.film import Film, FilmSettings, render

__all__ = ["Film", "FilmSettings", "render"]
