"""Frequency responses and margins of one joint's sampled loop, with its multiplier frozen.

Pure functions of settings and numbers. The loop is the one that runs: a joint behind a
zero-order hold, and the law, velocity source and integrator as they step from sample to sample.
"""

from hpid_ros.frequency.family import (
    Case,
    FamilyMargins,
    LoopFamily,
    family_margins,
    loop_family,
)
from hpid_ros.frequency.loop import FrozenLoop
from hpid_ros.frequency.margins import Margins, margins_of
from hpid_ros.frequency.plant import SampledJoint

__all__ = [
    "Case",
    "FamilyMargins",
    "FrozenLoop",
    "LoopFamily",
    "Margins",
    "SampledJoint",
    "family_margins",
    "loop_family",
    "margins_of",
]
