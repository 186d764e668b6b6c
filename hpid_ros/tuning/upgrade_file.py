"""A proposal as a controller parameter file, with a comment on every number."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from hpid_ros.control import LOOP_PARAMETERS
from hpid_ros.control.model_settings import MODEL_PARAMETERS
from hpid_ros.control.parameters import Value
from hpid_ros.names import ANYWHERE, controller_name
from hpid_ros.tuning.upgrade import Upgrade

_COMMENT_COLUMN = 48
_SPECS = {**LOOP_PARAMETERS, **MODEL_PARAMETERS}


def upgrade_text(
    upgrades: Sequence[Upgrade], header: Sequence[str], notes: Mapping[str, Sequence[str]]
) -> str:
    """Return the file.

    Args:
        upgrades: One for each joint.
        header: Lines about the whole, without the comment sign.
        notes: Further lines about a joint, by its name.
    """
    joints = ", ".join(each.settings.joint for each in upgrades)
    lines = [*(f"# {line}".rstrip() for line in header), ""]
    lines += [f"{ANYWHERE}joint_controllers:", "  ros__parameters:", f"    joints: [{joints}]"]
    for each in upgrades:
        lines += ["", *(f"# {note}" for note in notes.get(each.settings.joint, ()))]
        lines += [f"{ANYWHERE}{controller_name(each.settings.joint)}:", "  ros__parameters:"]
        lines += _parameters(each)
    return "\n".join(lines) + "\n"


def _parameters(upgrade: Upgrade) -> list[str]:
    lines: list[str] = []
    section = ""
    for name, value in upgrade.settings.to_parameters().items():
        *path, last = name.split(".")
        inner = ".".join(path)
        if inner and inner != section:
            lines.append(f"    {inner}:")
        section = inner
        entry = f"{'      ' if inner else '    '}{last}: {_value(value)}"
        lines.append(f"{entry:<{_COMMENT_COLUMN}}  # {_reason(upgrade, name, value)}")
    return lines


def _value(value: Value) -> str:
    """Return a YAML scalar that ROS reads as the type it is."""
    if isinstance(value, str):
        return value if value.isidentifier() else json.dumps(value)
    text = f"{value:.6g}"
    return text if "." in text and "e" not in text else f"{value:.10f}".rstrip("0") + "0"


def _reason(upgrade: Upgrade, name: str, value: Value) -> str:
    if name in upgrade.reasons:
        return upgrade.reasons[name]
    spec = _SPECS[name]
    origin = "default" if value == spec.default else "as before"
    text = spec.description
    is_word = text[1:2].islower()  # and no abbreviation
    return f"{origin}: {text[0].lower() if is_word else text[0]}{text[1:]}"
