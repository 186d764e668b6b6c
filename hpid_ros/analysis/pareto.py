"""Which of many compromises are not beaten in both of two costs."""

from __future__ import annotations

import math
from collections.abc import Sequence


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the places of the points that no other point beats in both costs.

    Of equal points the first is there; one that is not finite is not.

    Args:
        points: Two costs of each.

    Returns:
        In the order of the first cost.
    """
    finite = [k for k, point in enumerate(points) if all(map(math.isfinite, point))]
    front: list[int] = []
    least = math.inf
    for place in sorted(finite, key=lambda k: points[k]):
        if points[place][1] < least:
            front.append(place)
            least = points[place][1]
    return front
