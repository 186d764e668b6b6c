"""Short experiments for tests."""

import yaml

from hpid_ros.base.resources import share_folder

TRACKING = share_folder() / "config" / "experiments" / "tracking.yaml"


def changed(document, **changes):
    """Change a document and return it; ``a__b=1`` changes a.b."""
    for dotted, value in changes.items():
        *path, last = dotted.split("__")
        inner = document
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return document


def write_experiment(folder, file="short.yaml", duration=0.3, **changes):
    """Write tracking.yaml, shortened and changed, and return where."""
    document = yaml.safe_load(TRACKING.read_text())
    document |= {"name": "short", "duration": duration}
    # Whatever a test is about but for the engines themselves: a step is thirty times faster.
    document["simulation"] = {"engine": "mujoco", "physics_steps": 1}
    # Patient: on a busy machine a late answer is asked for again, and counted in the result.
    document["control"] = {"rate": 1000, "answer_timeout": 120.0}
    path = folder / file
    path.write_text(yaml.safe_dump(changed(document, **changes), sort_keys=False))
    return path
