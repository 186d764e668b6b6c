"""Certificates beside a result, and their verification from the file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.control import LoopSettings
from hpid_ros.stability.certificate import Certificate
from hpid_ros.stability.gain_check import check_gains
from hpid_ros.stability.verdict import verify_certificate

_KEY = "certificates"


class Verification(NamedTuple):
    """What became of one saved certificate."""

    holds: bool  # whether it holds
    text: str  # for people: the certified degrees and the margin, or why it does not


def certificates(controllers: Mapping[str, Sequence[LoopSettings]]) -> dict[str, Any]:
    """Certify every homogeneous loop whose inertia is known."""
    loops = {
        f"{label} {each.joint}": each
        for label, settings in controllers.items()
        for each in settings
        if each.law == "hpid" and each.plant_inertia > 0.0 and each.gains.i > 0.0
    }
    verdicts = check_gains(
        [(each, (each.plant_inertia, each.plant_inertia)) for each in loops.values()]
    )
    return {
        _KEY: {
            name: verdict.certificate or {"reason": verdict.reason}
            for name, verdict in zip(loops, verdicts, strict=True)
        }
    }


def saved_certificates(path: Path) -> dict[str, Mapping[str, Any]]:
    """Return the certificates of a file by name; empty when it is another kind of file."""
    if path.suffix != ".json":
        return {}
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot read {path}: {reason}") from None
    except (ValueError, RecursionError) as error:
        raise SettingError(f"cannot read {path}: {error}") from None
    found = document.get(_KEY) if isinstance(document, Mapping) else None
    return dict(found) if isinstance(found, Mapping) else {}


def verify(saved: Mapping[str, Any]) -> Verification:
    """Check one saved certificate anew, without anything of the search that found it."""
    if "reason" in saved:
        return Verification(False, f"none was found: {saved['reason']}")
    certificate = Certificate.from_mapping(saved)
    try:
        margins = verify_certificate(certificate)
    except (GainError, np.linalg.LinAlgError) as error:
        return Verification(False, f"does NOT hold: {error}")
    return Verification(
        True,
        f"holds, mu {certificate.lower:+.3f} to {certificate.upper:+.3f}, "
        f"least rate {margins.rate:.3g} 1/s",
    )
