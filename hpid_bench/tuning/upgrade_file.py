"""The parameter file of an upgrade, with a comment on every number."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from hpid_bench.tuning.gain_design import number_text
from hpid_bench.tuning.upgrade import Upgrade
from hpid_ros.base.names import ANYWHERE, controller_name
from hpid_ros.base.text import shown
from hpid_ros.base.units import of_slide, unit_over
from hpid_ros.base.yaml_text import inline_yaml
from hpid_ros.control.parameter_files import INERTIA_RANGES
from hpid_ros.control.settings import PARAMETERS, LoopSettings, Value

_COMMENT_COLUMN = 48
_LEAST_PLAIN = 1e-4  # what is smaller would lose digits without an exponent


def upgrade_text(
    loops: Sequence[Upgrade | LoopSettings],
    header: Sequence[str],
    notes: Mapping[str, Sequence[str]],
    slides: Collection[str] = frozenset(),
) -> str:
    settings = [each.settings if isinstance(each, Upgrade) else each for each in loops]
    joints = inline_yaml([each.joint for each in settings])
    lines = [*(f"# {shown(line)}".rstrip() for line in header), ""]
    lines += [f"{ANYWHERE}joint_controllers:", "  ros__parameters:", f"    joints: {joints}"]
    lines += _inertia_ranges([each for each in loops if isinstance(each, Upgrade)], slides)
    for each, own in zip(loops, settings, strict=True):
        name = controller_name(own.joint)
        is_slide = own.joint in slides
        lines += ["", *controller_section(name, each, notes.get(own.joint, ()), is_slide=is_slide)]
    return "\n".join(lines) + "\n"


def controller_section(
    name: str, loop: Upgrade | LoopSettings, notes: Sequence[str], *, is_slide: bool
) -> list[str]:
    settings, reasons = (loop.settings, loop.reasons) if isinstance(loop, Upgrade) else (loop, {})
    said = [f"# {shown(note)}" for note in notes]
    parameters = _parameters(settings, reasons, is_slide=is_slide)
    if is_slide:
        said = [of_slide(line) for line in said]
    return [*said, f"{ANYWHERE}{name}:", "  ros__parameters:", *parameters]


def _inertia_ranges(upgrades: Sequence[Upgrade], slides: Collection[str]) -> list[str]:
    """Return a section for the commands that judge gains; a controller has one inertia."""
    if not upgrades:
        return []
    unit = unit_over("kg m^2", (each.settings.joint in slides for each in upgrades))
    lines = [
        "",
        f"# Least and largest inertia [{unit}], read by hpid check-gains and upgrade; no node",
    ]
    lines += ["# has this name.", f"{ANYWHERE}{INERTIA_RANGES}:", "  ros__parameters:"]
    for each in upgrades:
        low, high = (_value(value) for value in each.inertia)
        lines.append(f"    {_value(each.settings.joint)}: [{low}, {high}]")
    return lines


def _parameters(
    settings: LoopSettings, reasons: Mapping[str, str], *, is_slide: bool
) -> list[str]:
    lines: list[str] = []
    section = ""
    for name, value in settings.to_parameters().items():
        *path, last = name.split(".")
        inner = ".".join(path)
        if inner and inner != section:
            lines.append(f"    {inner}:")
        section = inner
        entry = f"{'      ' if inner else '    '}{last}: {_value(value)}"
        reason = _reason(reasons, name, value)
        said = of_slide(reason) if is_slide else reason
        lines.append(f"{entry:<{_COMMENT_COLUMN}}  # {said}")
    return lines


def _value(value: Value) -> str:
    """Return a YAML scalar that ROS reads as the type it is."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return inline_yaml(value)
    if 0.0 < abs(value) < _LEAST_PLAIN:
        return number_text(value)
    text = f"{value:.6g}"
    return text if "." in text and "e" not in text else f"{value:.10f}".rstrip("0") + "0"


def _reason(reasons: Mapping[str, str], name: str, value: Value) -> str:
    if name in reasons:
        return reasons[name]
    spec = PARAMETERS[name]
    origin = "default" if value == spec.default else "as before"
    text = spec.description
    is_word = text[1:2].islower()  # and no abbreviation
    return f"{origin}: {text[0].lower() if is_word else text[0]}{text[1:]}"
