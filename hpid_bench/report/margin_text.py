"""Margins of a loop as words, the same in every command."""

from __future__ import annotations

import math

from hpid_ros.stability.margins import Margins


def gain_margin_text(margins: Margins) -> str:
    """Return by how much the gain may fall and grow, in [dB]."""
    return " ".join(
        f"{20.0 * math.log10(factor) if factor else -math.inf:+.1f}"
        for factor in (margins.gain_reduction, margins.gain)
    )


def phase_margin_text(margins: Margins) -> str:
    """Return the phase margin in [deg]."""
    return f"{math.degrees(margins.phase):.3g}"


def delay_margin_text(margins: Margins) -> str:
    """Return the delay margin in [ms]."""
    return f"{1e3 * margins.delay:.3g}"


def sensitivity_text(margins: Margins) -> str:
    """Return the peak of the sensitivity."""
    return f"{margins.sensitivity:.2f}"
