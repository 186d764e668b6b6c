"""A controller that was found, as an entry of an experiment file's ``compare``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.search_space import source_label

_FREE = {
    "pid": ("gains.p", "gains.i", "gains.d"),
    "hpid": ("mu", "norm.error_scale", "norm.rate_weight"),
}
_JOINTS = "joints"


def compare_entry(
    experiment: Experiment, law: str, loops: Sequence[LoopSettings]
) -> dict[str, Any]:
    """Return the entry that gives these loops in this experiment file, or one that extends it.

    What the search did not touch stands as in the entry that it began with: the baseline's, or
    for the homogeneous law that of the first homogeneous controller.

    Args:
        experiment: The experiment of the search.
        law: ``pid`` or ``hpid``.
        loops: One for each driven joint.
    """
    source = source_label(experiment, law)
    written = yaml.safe_load(experiment.text)["compare"][source] or {}
    common = _flat({key: value for key, value in written.items() if key != _JOINTS})
    each = {joint: _flat(entry) for joint, entry in written.get(_JOINTS, {}).items()}
    common["law"] = law
    for name in _FREE[law]:
        values = {loop.joint: loop.to_parameters()[name] for loop in loops}
        for parameters in (common, *each.values()):
            parameters.pop(name, None)
        if len(set(values.values())) == 1:
            common[name] = next(iter(values.values()))
        else:
            for joint, value in values.items():
                each.setdefault(joint, {})[name] = value
    entry = _nested(common)
    own = {joint: _nested(each[joint]) for joint in experiment.world.joints if each.get(joint)}
    return {**entry, _JOINTS: own} if own else entry


def _flat(entry: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in entry.items():
        below = value.items() if isinstance(value, Mapping) else [(None, value)]
        flat |= {key if rest is None else f"{key}.{rest}": each for rest, each in below}
    return flat


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        section, _, key = name.rpartition(".")
        (nested.setdefault(section, {}) if section else nested)[key] = value
    return nested
