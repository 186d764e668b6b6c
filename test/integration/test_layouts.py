"""The layouts for PlotJuggler and Foxglove show topics that the nodes publish, of every joint."""

import importlib.util
import json
import re
import xml.etree.ElementTree as ET

import pytest
from harness.places import ROOT

from hpid_ros.base.files import share_folder
from hpid_ros.base.names import controller_name
from hpid_ros.experiment.description import load_experiment

pytestmark = pytest.mark.repository

CONFIG = share_folder() / "config"
JOINTS = load_experiment(CONFIG / "experiments" / "paper.yaml").world.joints
SCRIPT = ROOT / "tools" / "make_layouts.py"
TOPICS = {
    "/joint_states",
    "/joint_commands",
    *(f"/{controller_name(j)}/{topic}" for j in JOINTS for topic in ("reference", "terms")),
}


@pytest.fixture(scope="module")
def make_layouts():
    if not SCRIPT.exists():
        pytest.skip("docs/ is not installed: run from the checkout")
    spec = importlib.util.spec_from_file_location("make_layouts", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_files_are_what_the_script_writes(make_layouts):
    assert (CONFIG / "plotjuggler.xml").read_text() == make_layouts.plotjuggler(JOINTS)
    assert (CONFIG / "foxglove.json").read_text() == make_layouts.foxglove(JOINTS)


def test_plotjuggler_subscribes_to_what_it_draws_and_draws_every_joint():
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    selected = set(root.find("Plugins/plugin/selected_topics").get("value").split(";"))
    assert selected == TOPICS
    curves = [curve.get("name") for curve in root.iter("curve")]
    fields = re.compile(r"(.+)/([^/]+)/(position|effort)")
    matches = [fields.fullmatch(curve) for curve in curves]
    assert all(matches)
    assert {match[1] for match in matches} == TOPICS
    for tab in root.iter("Tab"):
        assert [area.get("name") for area in tab.iter("DockArea")] == list(JOINTS)
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter)
        assert len(splitter.get("sizes").split(";")) == len(splitter)


def test_foxglove_finds_every_joint_at_its_place_and_every_panel_exists():
    document = json.loads((CONFIG / "foxglove.json").read_text())
    panels = document["configById"]

    def leaves(node):
        if isinstance(node, str):
            return [node]
        return leaves(node["first"]) + leaves(node["second"])

    tabs = {tab["title"]: leaves(tab["layout"]) for tab in panels[document["layout"]]["tabs"]}
    assert {leaf for tab in tabs.values() for leaf in tab} == set(panels) - {document["layout"]}
    for k, (joint, name) in enumerate(zip(JOINTS, tabs["positions"], strict=True)):
        reference, measured = (path["value"] for path in panels[name]["paths"])
        assert measured == f"/joint_states.position[{k}]"
        assert reference == f"/{controller_name(joint)}/reference.position[0]"
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert {re.split(r"\.(?:position|effort)\[\d\]", path)[0] for path in paths} <= TOPICS
