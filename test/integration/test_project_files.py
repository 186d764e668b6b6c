"""What GitHub, bloom and whoever cites the package read is true of this version."""

import re

import pytest
import yaml
from harness.places import ROOT

import hpid_ros

pytestmark = pytest.mark.repository

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]


def steps(workflow):
    document = yaml.safe_load(workflow.read_text())
    for job in document["jobs"].values():
        yield from ((job, step) for step in job["steps"])


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_uses_released_actions_and_files_that_are_there(workflow):
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for _, step in steps(workflow):
        assert step.keys() & {"uses", "run"}
        assert re.fullmatch(r"[\w-]+/[\w-]+@v[\d.]+", step.get("uses", "a/b@v1"))
        for target in re.findall(r"\bmake ([a-z]+)", step.get("run", "")):
            assert target in targets
        for path in re.findall(r"(?<![\w/])((?:tools|\.ci)/[\w.]+)", step.get("run", "")):
            assert (ROOT / path).exists()


def test_the_suite_and_the_wheel_are_tried_with_every_python_that_is_named():
    matrices = [
        job["strategy"]["matrix"]["python"]
        for workflow in WORKFLOWS
        for job, _ in steps(workflow)
        if "python" in job.get("strategy", {}).get("matrix", {})
    ]
    assert matrices
    assert all(matrix == PYTHONS for matrix in matrices)
    setup = (ROOT / "setup.py").read_text()
    assert re.findall(r"Python :: (3\.\d+)\"", setup) == PYTHONS


@pytest.mark.parametrize("form", [each for each in FORMS if each.stem != "config"])
def test_an_issue_form_has_what_github_asks_for(form):
    document = yaml.safe_load(form.read_text())
    assert document.keys() >= {"name", "description", "body"}
    fields = [each for each in document["body"] if each["type"] != "markdown"]
    assert all(each["attributes"]["label"] for each in fields)
    assert len({each["id"] for each in fields}) == len(fields)


def test_the_citation_is_of_this_version_and_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == hpid_ros.__version__
    assert citation["license"] == "Apache-2.0"
    (paper,) = citation["references"]
    assert paper["identifiers"][0]["value"] == "arXiv:2511.16406"
    assert [each["family-names"] for each in paper["authors"]] == ["Luna", "Chairez", "Polyakov"]


def test_the_changelog_has_every_entry_in_a_category_or_below_the_last_sorting():
    text = (ROOT / "CHANGELOG.rst").read_text()
    sorted_in, mark, _ = text.partition(".. What is newer than the last sorting")
    assert mark
    assert len(re.findall(r"^\* \*\*.+\*\*$", sorted_in, re.MULTILINE)) >= 5
    assert not re.findall(r"^\* (?!\*\*)", sorted_in, re.MULTILINE)


def pins(text):
    """Return the versions that a text asks for, by library."""
    found = re.findall(r'"?([A-Za-z][\w.-]*)"?(?: = ")?(>=[\d.]+,<[\d.]+)', text)
    return {name.lower().replace("-python", "").replace("-base", ""): each for name, each in found}


@pytest.mark.parametrize("path", ["docker/Dockerfile", "docs/install.md", "pixi.toml"])
def test_the_other_ways_to_install_ask_for_the_same_versions(path):
    wanted = pins((ROOT / "setup.py").read_text())
    wanted |= {"pinocchio": wanted["pin"]}
    asked = pins((ROOT / path).read_text())
    assert {"mujoco", "rosbags", "backports.zstd"} <= asked.keys()
    assert {name: wanted[name] for name in asked} == asked
