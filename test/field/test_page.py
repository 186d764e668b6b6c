"""docs/field.md and the tests: each row names one that exists."""

import ast
import re
from functools import cache

import pytest
from harness.places import ROOT

PAGE = (ROOT / "docs" / "field.md").read_text()
TABLE = [line for line in PAGE.splitlines() if line.startswith("|")]
HEAD = "| report | what it was about, in our own words | what happens here | test |"
ROWS = [line for line in TABLE if line != HEAD and not re.fullmatch(r"[|-]+", line)]
LEAST = 60


def cells_of(row):
    """Return what stands between bars, those in code left out."""
    assert row.endswith("|"), row
    inner = re.sub(r"`[^`]*`", lambda code: code[0].replace("|", "\0"), row)
    return [cell.strip().replace("\0", "|") for cell in inner[1:-1].split("|")]


@cache
def names_in(file):
    """Return the names of the tests of a file below test/."""
    tree = ast.parse((ROOT / "test" / file).read_text())
    return {each.name for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)}


def test_the_page_has_its_rows():
    assert len(ROWS) >= LEAST
    assert TABLE.count(HEAD) * 2 + len(ROWS) == len(TABLE)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_a_row_has_four_cells_and_names_a_test_that_there_is(row):
    cells = cells_of(row)
    assert len(cells) == 4
    assert all(cells)
    reports, _, _, test = cells
    assert all(re.fullmatch(r"[\w.-]+/[\w.-]+#\d+", each) for each in reports.split(", "))
    for each in re.findall(r"`([^`]+)`", test):
        file, name = each.split("::")
        assert name in names_in(file), each
    assert re.fullmatch(r"`[^`]+`(, `[^`]+`)*", test)


def test_no_report_stands_twice():
    """The owner of a repository does not count: some have moved."""
    reports = [
        each.rpartition("/")[2] for row in ROWS for each in cells_of(row)[0].lower().split(", ")
    ]
    assert sorted(reports) == sorted(set(reports))
