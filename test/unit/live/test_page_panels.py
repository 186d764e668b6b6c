"""What the page's parts show and choose, without a browser."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from harness.simulated_graph import SimulatedGraph, arm
from nicegui import Client, ui

from hpid_bench.live.advice import Advice
from hpid_bench.live.known_controllers import Samples
from hpid_bench.live.page.panel import AllParameters, TuningPanel
from hpid_bench.live.page.parts import Viewer
from hpid_bench.live.page.trial_panel import TrialPanel
from hpid_bench.live.page.view import JointTable, PageView, _state
from hpid_bench.live.session import LiveSession
from hpid_bench.live.trials import Trials

NODES = sorted(arm())


@pytest.fixture
def session():
    return LiveSession(SimulatedGraph(arm()), SimpleNamespace(ask=lambda *_: None))


@pytest.fixture
def viewer(session, monkeypatch):
    """Return the viewer of a page whose person has control and has chosen the first joint."""
    for name in ("run_javascript", "timer"):  # which wait for a browser
        monkeypatch.setattr(ui, name, lambda *_: None)
    with Client(ui.page("/")) as client:
        session.control_lock.join(client.id)
        yield Viewer(session, Trials(session), client.id, lambda: NODES[:1])


def test_a_controller_that_no_pulse_has_seen_has_no_row_yet(session, viewer):
    table = JointTable(viewer, TuningPanel(viewer).refresh, lambda: 10.0)
    table.refresh()
    assert table.ticked == []
    session.pulse()
    table.refresh()
    assert table.ticked == NODES[:1]


def test_a_joint_whose_controller_was_gone_when_it_was_chosen_is_drawn(
    session, viewer, monkeypatch
):
    scripts = []
    monkeypatch.setattr(ui, "run_javascript", scripts.append)
    session.graph.gone.add(NODES[0])
    session.pulse()
    view = PageView(session, viewer.trials)
    view._refresh()
    assert view._table.chosen == []
    assert NODES[0] in scripts[-1]


@pytest.fixture
def fields(session, viewer):
    session.pulse()
    panel = AllParameters(viewer, lambda: panel.refresh())
    session.graph.set(NODES[0], {"velocity_max": 1.23456789})
    session.pulse()
    panel._place.value = True
    return panel._fields


def test_a_field_that_is_left_as_it_was_chooses_nothing(session, fields):
    fields["velocity_max"].sanitize()  # as whenever it loses the focus
    assert session.tuning.staged_sets(NODES) == {}


def test_a_value_that_is_refused_does_not_stay_in_its_field(session, fields):
    fields["velocity_max"].value = -3.0
    assert fields["velocity_max"].value == 1.23456789
    fields["velocity_max"].value = 3.0
    assert session.tuning.staged_sets(NODES) == {NODES[0]: {"velocity_max": 3.0}}


@pytest.mark.parametrize(("law", "is_warned"), [("hpid", True), ("pid", False)])
def test_only_the_homogeneous_law_can_have_a_degree_that_is_not_certified(
    session, viewer, monkeypatch, law, is_warned
):
    monkeypatch.setattr(session, "advice", lambda *_, **__: (Advice((-0.1, 0.1)), True))
    session.pulse()
    session.tuning.stage(NODES, "law", law)
    panel = TuningPanel(viewer)
    panel.refresh()
    assert ("NOT certified" in panel._certified.text) is is_warned  # of mu = -0.2


@pytest.mark.parametrize("name", ["chosen", "in force", "what is chosen", "nothing"])
def test_a_snapshot_of_any_name_is_a_variant_of_its_own(session, viewer, name):
    session.pulse()
    session.tuning.keep(name, NODES)
    session.tuning.stage(NODES, "mu", 0.1)
    panel = TrialPanel(viewer)
    panel._offer()
    in_force, chosen, kept = (panel._variant(each, NODES, 2) for each in panel._one.options)
    assert len({in_force.label, chosen.label, kept.label}) == 3
    assert kept.values[NODES[0]]["mu"] == -0.2
    assert len(set(panel._other.options)) == 4


@pytest.mark.parametrize(
    ("efforts", "reference", "shown"),
    [
        (0.0, 0.0, ("active", "ok")),
        (50.0, 0.0, ("saturated", "warning")),
        (0.0, 0.4, ("far off", "warning")),
    ],
)
def test_a_joint_that_is_saturated_or_far_from_its_reference_is_not_green(
    session, efforts, reference, shown
):
    times = np.arange(1000.0) / 1000.0
    zeros = np.zeros_like(times)
    history = session.history(NODES[0])
    history.append(
        Samples(
            np.column_stack([times, zeros, zeros]),
            np.column_stack([times, zeros + efforts]),
            np.column_stack([times, zeros + reference, zeros]),
        )
    )
    seen = session.graph.controllers()[NODES[0]]
    assert _state(seen, history)[:2] == shown
    worse = replace(seen, health=seen.health._replace(level=2, message="states jump"))
    assert _state(worse, history) == ("active", "error", "states jump")
