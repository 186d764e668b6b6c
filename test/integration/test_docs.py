"""The documentation says what the code says."""

import importlib.util
import inspect
import pydoc
import re

import numpy as np
import pytest
from harness.places import ROOT

from hpid_ros.control import LOOP_PARAMETERS
from hpid_ros.nodes.parts.bridge import OVER_THE_FILE
from hpid_ros.nodes.parts.goals import FIXED_PARAMETERS, GOAL_PARAMETERS, joint_parameters

INTERFACES = (ROOT / "docs" / "interfaces.md").read_text()


def row_of(section, spec):
    """Return default, range and meaning of a parameter, as a section's table has them."""
    lines = INTERFACES.partition(f"## {section}\n")[2].partition("\n## ")[0].splitlines()
    (row,) = [line for line in lines if line.startswith(f"| `{spec.name}` |")]
    return tuple(cell.strip() for cell in row.split("|")[2:5])


@pytest.mark.parametrize("spec", LOOP_PARAMETERS.values(), ids=lambda spec: spec.name)
def test_every_parameter_is_documented_as_it_is(spec):
    default, allowed, meaning = row_of("joint_controller", spec)
    assert meaning == spec.description
    if isinstance(spec.default, float):
        assert float(default) == spec.default
        assert [float(each) for each in allowed.split(" to ")] == [spec.minimum, spec.maximum]
    elif spec.choices:
        assert default == spec.default
        assert re.findall(r"`(\w+)`", allowed) == list(spec.choices)


GOALS = (*GOAL_PARAMETERS, *FIXED_PARAMETERS, *joint_parameters("JOINT"))


@pytest.mark.parametrize("spec", GOALS, ids=lambda spec: spec.name)
def test_every_parameter_of_goals_is_documented_as_it_is(spec):
    row = shown(spec.default), range_of(spec), spec.description
    assert row_of("follow_joint_trajectory", spec) == row


def shown(value):
    return f"{value:g}" if type(value) is float else str(value).lower()


def range_of(spec):
    if isinstance(spec.default, float):
        return f"{spec.minimum:g} to {spec.maximum:g}".replace("0 to inf", "from 0")
    return ", ".join(f"`{each}`" for each in spec.choices or ("true", "false"))


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


def test_every_other_parameter_of_a_node_is_documented():
    declared = set()
    for path in (ROOT / "hpid_ros" / "nodes").rglob("*.py"):
        pattern = (
            r'(?:read_only|read_number|read_choice|positive)\(\s*(?:(?:self|node),\s*)?"(\w+)"'
        )
        declared |= set(re.findall(pattern, path.read_text()))
    declared |= set(OVER_THE_FILE)
    assert {"command_interface", "bag", "mode", "command_timeout", "seed"} <= declared
    assert not {name for name in declared if f"`{name}`" not in INTERFACES}


PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


def anchors_of(page):
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    found = set()
    for heading in re.findall(r"^#+ +(.+)$", text, re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).strip().replace(" ", "-"))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_anchors_are_headings(page):
    for target, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text()):
        there = (page.parent / target) if target else page
        assert there.exists(), f"{page.name}: {target}"
        if there.suffix == ".md":
            assert anchor in anchors_of(there), f"{page.name}: {target}#{anchor}"


def test_every_page_is_in_the_sites_contents():
    index = (ROOT / "docs" / "index.md").read_text()
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} - {"index"}
    assert {page for page in pages if not re.search(rf"^{page}$", index, re.MULTILINE)} == set()


def tool_named(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def test_the_tables_of_experiment_files_are_what_the_package_declares():
    name = "make_experiment_tables"
    tool = tool_named(name)
    text = tool.PAGE.read_text()
    assert {match["name"] for match in tool.BLOCK.finditer(text)} == set(tool.TABLES)
    assert tool.page(text) == text, f"python tools/{name}.py writes it"


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
    tool = tool_named("draw_theory")
    near = tool.transient(0.0, 1.0, 30.0, 1e-12)
    found = [tool.last_above(*near, 10.0**-k) for k in (2, 4, 6, 8)]
    for start in (1e1, 1e3, 1e6):
        found.append(tool.last_above(*tool.transient(0.0, start, 1e4, 0.1), 1.0))
    assert found == pytest.approx(exact, abs=1e-3)
    (row,) = re.findall(r"^\| PID \|.+", (ROOT / "docs" / "theory.md").read_text(), re.MULTILINE)
    documented = [float(each) for each in re.findall(r"([\d.]+) s", row)]
    assert documented == pytest.approx(exact, abs=6e-3)
