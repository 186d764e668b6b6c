"""The documentation says what the code says."""

import ast
import importlib
import importlib.util
import inspect
import json
import pydoc
import re
import shlex
from itertools import chain
from xml.etree import ElementTree

import numpy as np
import pytest
from harness.places import ROOT

from hpid_bench.cli.main import SUBCOMMANDS as COMMANDS_OF_HPID
from hpid_bench.cli.main import _parser as parser_of
from hpid_bench.cli.main import main
from hpid_bench.experiment.description import load_experiment
from hpid_ros.base.names import controller_name
from hpid_ros.nodes.parts.command_interfaces import COMMAND_INTERFACES

pytestmark = pytest.mark.repository


def module_at(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


tables = module_at(ROOT / "docs" / "declared.py")
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
INTERFACES = (ROOT / "docs" / "interfaces.md").read_text()


def tables_of(page):
    """Return the names of the tables that a page has in place of this text on the site."""
    return re.findall(r"^```\{declared\} (\S+)$", page, re.MULTILINE)


def test_every_declared_table_stands_in_one_page():
    pages = [page.read_text() for page in PAGES]
    assert sorted(name for page in pages for name in tables_of(page)) == sorted(tables.TABLES)


@pytest.mark.parametrize("name", tables.TABLES)
def test_a_declared_table_has_a_meaning_for_each_name(name):
    rows = list(tables.TABLES[name]())
    assert len({row[0] for row in rows}) == len(rows) > 0
    assert all(row[-1] and "|" not in "".join(row) for row in rows)


OFFERED = re.findall(r"auto(?:class|function):: (\S+)", (ROOT / "docs" / "api.md").read_text())


@pytest.mark.parametrize("name", OFFERED)
def test_what_is_offered_is_documented_with_its_arguments(name):
    offered = pydoc.locate(name)
    members = vars(offered).items() if inspect.isclass(offered) else [(name, offered)]
    if inspect.isclass(offered):
        assert inspect.getdoc(offered)
    for member, value in members:
        value = getattr(value, "__func__", getattr(value, "fget", value))
        if inspect.isfunction(value) and not member.startswith("_"):
            arguments = set(inspect.signature(value).parameters) - {"self", "cls"}
            text = value.__doc__ or ""
            assert text, f"{name}.{member}"
            missing = {each for each in arguments if not re.search(rf"^ +{each}:", text, re.M)}
            assert not missing, f"{name}.{member}"


NODES = [path.stem for path in (ROOT / "hpid_ros" / "nodes").glob("*[!_].py")]
USAGES = [
    *(importlib.import_module(f"hpid_ros.nodes.{name}").USAGE for name in NODES),
    importlib.import_module("hpid_bench.live.live_tuner").USAGE,
]


@pytest.mark.parametrize("usage", USAGES, ids=lambda usage: usage.name)
def test_every_parameter_of_a_node_is_documented(usage):
    page = "\n".join([INTERFACES, *chain(*map(tables.markdown, tables_of(INTERFACES)))])
    names = {name.replace(".*", ".JOINT") for name in usage.parameters} - {"status_fd"}
    assert names
    missing = {name for name in names if f"`{name}`" not in page}
    assert not missing, f"docs/interfaces.md does not have these parameters of {usage.name}"


def executables():
    """Return the names of the nodes that a build installs, as setup.py lists them."""
    tree = ast.parse((ROOT / "setup.py").read_text())
    assigned = (each for each in tree.body if isinstance(each, ast.Assign))
    (names,) = (each.value for each in assigned if each.targets[0].id == "EXECUTABLES")
    return ast.literal_eval(names)


def test_every_executable_has_a_section_and_is_started_by_a_test():
    assert sorted(executables()) == sorted(NODES), "EXECUTABLES of setup.py, hpid_ros/nodes"
    headings = "\n".join(re.findall(r"^## (.+)$", INTERFACES, re.MULTILINE))
    started = (ROOT / "test" / "graph" / "test_given_parameters.py").read_text()
    for name in NODES:
        is_there = re.search(rf"\b{name}\b", headings) or f"**{name}**" in INTERFACES
        assert is_there, f"docs/interfaces.md has no section on {name}"
        assert f'"{name}"' in started, f"test/graph/test_given_parameters.py starts no {name}"


def command_interfaces():
    """Return pairs of a node and the name of one of its command interfaces."""
    for name, each in COMMAND_INTERFACES.items():
        topics = {
            "joint_controller": each.controller_topic,
            "joint_command_merger": each.merger_topic,
        }
        yield from ((node, name) for node, topic in topics.items() if topic)


@pytest.mark.parametrize(("node", "name"), command_interfaces())
def test_every_command_interface_is_documented_and_tried(node, name):
    section = INTERFACES.split(f"\n## {node}\n")[1].split("\n## ")[0]
    (row,) = re.findall(r"^\| `command_interface` \|.+", section, re.MULTILINE)
    assert "(#command-interfaces)" in row, f"docs/interfaces.md: {node} does not lead to the table"
    tests = [each.read_text() for each in (ROOT / "test" / "graph").glob("*.py")]
    assert any(f'"{name}"' in each for each in tests), f"test/graph tries no {name}"


PROSE = "\n".join(page.read_text() for page in PAGES if page.name != "CONTRIBUTING.md")
SOURCES_OF_TESTS = "\n".join(path.read_text() for path in (ROOT / "test").rglob("*.py"))


@pytest.mark.parametrize("command", COMMANDS_OF_HPID)
def test_every_subcommand_is_documented_and_run_and_its_examples_can_be_typed(command):
    is_named = re.search(rf"\bhpid {command}\b|`{command}`", PROSE)
    assert is_named, f"no page of docs/ says when to use hpid {command}"
    assert f'"{command}"' in SOURCES_OF_TESTS, f"no test runs hpid {command}"
    help_text = parser_of([command])._actions[-1].choices[command].description
    examples = re.findall(r'^  (?:eval "\$\()?(hpid [^>|)#\n]+)', help_text, re.MULTILINE)
    assert examples
    for example in examples:
        _, *arguments = shlex.split(example)
        parser_of(arguments).parse_args(arguments)  # or SystemExit


def test_contributing_names_files_that_there_are():
    page = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(r"`([\w./]+/[\w.]+\.(?:py|c|h|html|md))`", page))
    houses = (ROOT, ROOT / "hpid_ros", ROOT / "hpid_bench", ROOT / "hpid_bench" / "report")
    own = {"control/my_law.py", "nodes/my_node.py"}  # to be written
    missing = {name for name in named - own if not any((each / name).exists() for each in houses)}
    assert len(named) > 30
    assert not missing, "CONTRIBUTING.md"


def test_the_command_interfaces_are_those_of_the_page():
    section = INTERFACES.partition("## Command interfaces")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| `(\S+)` \| (\S+) \| (\S+) \|", section, re.MULTILINE)
    declared = [
        (name, each.message, _topic(each.controller_topic), _topic(each.merger_topic))
        for name, each in COMMAND_INTERFACES.items()
    ]
    assert rows == declared


def _topic(name):
    return f"`{name}`" if name else "-"


def anchors_of(page):
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    found = set()
    for heading in re.findall(r"^#+ +(.+)$", text, re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).strip().replace(" ", "-"))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_there_are(page):
    for target, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]+))?\)", page.read_text()):
        there = (page.parent / target) if target else page
        assert there.exists(), f"{page.name}: {target}"
        if anchor and there.suffix == ".md":
            assert anchor in anchors_of(there), f"{page.name}: {target}#{anchor}"


def test_every_page_is_in_the_sites_contents():
    index = (ROOT / "docs" / "index.md").read_text()
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} - {"index"}
    assert {page for page in pages if not re.search(rf"^{page}$", index, re.MULTILINE)} == set()


def exact_time_of_the_pid(level):
    """Return when max(|e|, |de/dt|) stays below a level, from e = 1, de/dt = 0.

    Gains 3, 1, 3 on a unit inertia have a triple pole at -1/s, so that the solution from (1, 0, 0)
    is e = exp(-t) (1 + t - t^2).
    """
    t = np.linspace(0.0, 40.0, 400_001)
    sizes = np.exp(-t) * np.maximum(np.abs(1.0 + t - t**2), np.abs(t**2 - 3.0 * t))
    return t[np.flatnonzero(sizes > level)[-1] + 1]


def test_the_theorys_times_of_the_pid_are_the_exact_ones():
    exact = [exact_time_of_the_pid(10.0**-k) for k in (2, 4, 6, 8, 1, 3, 6)]
    tool = module_at(ROOT / "tools" / "draw_theory.py")
    near = tool.transient(0.0, 1.0, 30.0, 1e-12)
    found = [tool.last_above(*near, 10.0**-k) for k in (2, 4, 6, 8)]
    for start in (1e1, 1e3, 1e6):
        found.append(tool.last_above(*tool.transient(0.0, start, 1e4, 0.1), 1.0))
    assert found == pytest.approx(exact, abs=1e-3)
    (row,) = re.findall(r"^\| PID \|.+", (ROOT / "docs" / "theory.md").read_text(), re.MULTILINE)
    documented = [float(each) for each in re.findall(r"([\d.]+) s", row)]
    assert documented == pytest.approx(exact, abs=6e-3)


CONFIG = ROOT / "config"
JOINTS = load_experiment(CONFIG / "experiments" / "paper.yaml").world.joints
TOPICS = {
    "/joint_states",
    "/joint_commands",
    *(f"/{controller_name(j)}/{topic}" for j in JOINTS for topic in ("reference", "terms")),
}


def test_the_layouts_are_what_the_script_writes():
    tool = module_at(ROOT / "tools" / "make_layouts.py")
    assert (CONFIG / "plotjuggler.xml").read_text() == tool.plotjuggler(JOINTS)
    assert (CONFIG / "foxglove.json").read_text() == tool.foxglove(JOINTS)


def test_plotjuggler_subscribes_to_what_it_draws_and_draws_every_joint():
    root = ElementTree.parse(CONFIG / "plotjuggler.xml").getroot()
    selected = set(root.find("Plugins/plugin/selected_topics").get("value").split(";"))
    assert selected == TOPICS
    fields = re.compile(r"(.+)/([^/]+)/(position|effort)")
    matches = [fields.fullmatch(curve.get("name")) for curve in root.iter("curve")]
    assert {match[1] for match in matches} == TOPICS
    for tab in root.iter("Tab"):
        assert [area.get("name") for area in tab.iter("DockArea")] == list(JOINTS)


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


TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text()
FILES = dict(re.findall(r"```yaml\n# (\S+)\n(.*?)```", TUTORIAL, re.DOTALL))
COMMANDS = re.findall(r"^\$ (.+)$", TUTORIAL, re.MULTILINE)


def test_the_tutorial_can_be_followed(tmp_path, monkeypatch):
    """Its files are written, its commands typed, one after the other."""
    assert len(FILES) == 2
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS:
        program, *arguments = shlex.split(command)
        if program == "hpid":
            assert main(arguments) == 0, command
    assert (tmp_path / "report.html").is_file()
    text = (tmp_path / "my_hpid.yaml").read_text()
    assert text.count("law: hpid") == 2
    degrees = re.findall(r"^    mu: (\S+)", text, re.MULTILINE)
    assert all(float(degree) < -0.1 for degree in degrees)


def test_what_is_typed_on_the_robot_names_nodes_and_parameters_that_there_are():
    setup = (ROOT / "setup.py").read_text()
    typed = [command for command in COMMANDS if command.startswith("ros2 ")]
    assert len(typed) == 3
    for command in typed:
        for node in re.findall(r"ros2 run hpid_ros (\w+)", command):
            assert f'"{node}"' in setup
        for node in re.findall(r"ros2 param set (\S+) mu", command):
            assert f"{node}:" in FILES["my_pid.yaml"]
