"""Triangles of a Wavefront OBJ file, of all its parts; MuJoCo's reader takes the first alone."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import RobotDescriptionError


def triangles_of(file: Path) -> tuple[Numbers, NDArray[np.int32]]:
    """Return corners, (N, 3), in the file's units, and triangles of three corners each, (M, 3).

    Faces of more corners become fans. Everything but corners and faces is passed over.
    """
    corners: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                corners.append([float(word) for word in words[:3]])
            elif kind == "f":
                first, *rest = (_place(word, len(corners)) for word in words)
                faces += [(first, one, other) for one, other in pairwise(rest)]
        found = np.array(corners).reshape(-1, 3), np.array(faces, dtype=np.int32).reshape(-1, 3)
        if not faces or not 0 <= found[1].min() <= found[1].max() < len(corners):
            raise ValueError("no faces, or of corners that are not there")
    except (OSError, ValueError) as error:
        raise RobotDescriptionError(f"cannot read mesh {file}: {error}") from None
    return found


def _place(word: str, known: int) -> int:
    """Return which corner a face names: counted from 1, or backwards from those before it."""
    number = int(word.partition("/")[0])
    return number - 1 if number > 0 else known + number
