"""An exported plugin that is compiled once."""

import pytest
from harness.plugins import LOOPS, NAMES, Plugin, compile_plugin, export

from hpid_bench.experiment.in_process import controllers_document


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plugin")
    export(folder, LOOPS)
    return folder


@pytest.fixture(scope="session")
def library(exported):
    return compile_plugin(exported)


@pytest.fixture
def parameters():
    """What a controller's nodes read from config/joints.yaml."""
    document = controllers_document(LOOPS)
    found = {}
    for joint in NAMES:
        nested = document[f"/**/{joint}_controller"]["ros__parameters"]
        found[joint] = dict(_flat(nested))
    return found


def _flat(values, prefix=""):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


@pytest.fixture
def make(library, parameters):
    """Return what makes an active controller."""
    made = []

    def start(*, is_chained=False, update_rate=0, **changes):
        own = {joint: {**values, **changes.get(joint, {})} for joint, values in parameters.items()}
        plugin = Plugin(library, NAMES, is_chained=is_chained, update_rate=update_rate, **own)
        made.append(plugin)
        return plugin

    yield start
    for each in made:
        each.__exit__()


@pytest.fixture
def active(make):
    plugin = make()
    assert plugin.is_configured, plugin.log
    assert plugin.activate()
    return plugin
