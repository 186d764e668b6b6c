"""docs/field.md and the tests: each row names one that exists."""

import ast
import re
from functools import cache

import pytest
from harness.places import ROOT

HEAD = "| report | what it was about, in our own words | what happens here | test |"
SOURCES = "| source | what it holds | what happens here | test |"
LEAST = 60


def lines_of(page):
    """Return a page's rows of reports and of recordings and descriptions."""
    rows, kind = {HEAD: [], SOURCES: []}, None
    for line in page.splitlines():
        if not line.startswith("|"):
            kind = None
        elif kind is None:
            kind = line
        elif kind in rows and not re.fullmatch(r"[|-]+", line):
            rows[kind].append(line)
    return rows[HEAD], rows[SOURCES]


REPORTS, OTHERS = lines_of((ROOT / "docs" / "field.md").read_text())


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
    assert len(REPORTS) >= LEAST
    assert len(OTHERS) >= 30


@pytest.mark.parametrize("row", REPORTS + OTHERS, ids=lambda row: row.split("|")[1].strip())
def test_a_row_has_four_cells_and_names_a_test_that_there_is(row):
    cells = cells_of(row)
    assert len(cells) == 4
    assert all(cells)
    reports, _, _, test = cells
    names = reports.split(", ") if row in REPORTS else []
    assert all(re.fullmatch(r"[\w.-]+/[\w.-]+#\d+", each) for each in names)
    for each in re.findall(r"`([^`]+)`", test):
        file, name = each.split("::")
        assert name in names_in(file), each
    assert re.fullmatch(r"`[^`]+`(, `[^`]+`)*", test)


def test_no_report_stands_twice():
    """The owner of a repository does not count: some have moved."""
    reports = [
        each.rpartition("/")[2] for row in REPORTS for each in cells_of(row)[0].lower().split(", ")
    ]
    assert sorted(reports) == sorted(set(reports))
