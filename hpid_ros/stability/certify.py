"""Certifies one loop in a process of its own: parameters as JSON in, the interval as JSON out.

``python -m hpid_ros.stability.certify < parameters.json``
"""

from __future__ import annotations

import json
import sys

from hpid_ros.base.errors import HpidError
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.verdict import certified_degree_interval


def main() -> int:
    """Read parameters, write ``{"lower": .., "upper": ..}`` or ``{"reason": ..}``."""
    try:
        settings = LoopSettings.from_parameters(json.load(sys.stdin))
        interval = certified_degree_interval(
            settings.gains, settings.norm_family, settings.plant_inertia
        )
    except HpidError as error:
        answer: dict[str, object] = {"reason": str(error)}
    else:
        answer = {"lower": interval.lower, "upper": interval.upper}
    print(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
