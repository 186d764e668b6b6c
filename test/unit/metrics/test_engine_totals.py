"""Both engines: distances are taken seed by seed, and what is missing is said to be."""

import csv
import io
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.metrics.comparison import EngineTotal, engine_mapping
from hpid_ros.metrics.quantities import ITAE, IVC
from hpid_ros.report.export import engine_grids, engines_csv, format_distance
from hpid_ros.report.table import grids_markdown, grids_text


def total(bullet, mujoco, controller="PID", quantity=IVC, ratios=None):
    values = {"pybullet": bullet, "mujoco": mujoco}
    return EngineTotal("paper", controller, quantity, values, ratios or {})


numbers = st.dictionaries(st.integers(0, 9), st.floats(1e-3, 1e3), min_size=1)


@given(numbers, st.floats(0.5, 2.0))
def test_an_engine_that_is_so_much_off_with_every_seed_is_so_far_away(bullet, factor):
    found = total(bullet, {seed: factor * each for seed, each in bullet.items()})
    assert [*found.distances.values()] == pytest.approx([factor - 1.0] * len(bullet), abs=1e-12)
    assert found.distance == pytest.approx(factor - 1.0, abs=1e-12)
    assert found.largest_distance == pytest.approx(factor - 1.0, abs=1e-12)


def test_a_distance_is_between_runs_of_the_same_seed():
    """Medians alone would agree."""
    found = total({1: 1.0, 2: 2.0, 3: 3.0}, {3: 1.0, 2: 2.0, 1: 3.0, 4: 9.0})
    assert found.distances == pytest.approx({1: 2.0, 2: 0.0, 3: 1 / 3 - 1})
    assert (found.distance, found.largest_distance) == (0.0, 2.0)


def test_what_has_no_distance_and_what_has_an_infinite_one():
    assert total({1: 1.0}, {2: 1.0}).distance is None  # no seed in both
    assert total({}, {2: 1.0}).largest_distance is None
    assert total({1: math.nan}, {1: 1.0}).distance is None
    assert total({1: 0.0}, {1: 0.0}).distance == 0.0
    far = total({1: 0.0}, {1: 1.0})
    assert far.distance == math.inf
    mapping = engine_mapping([far])
    assert mapping["paper"]["PID"]["ivc"]["distance"] is None
    json.dumps(mapping, allow_nan=False)


@pytest.mark.parametrize(
    ("distance", "text"),
    [(0.0012, "+0.120 %"), (-0.5, "-50.0 %"), (0.0, "+0.000 %"), (None, "-"), (math.inf, "inf")],
)
def test_distances_are_percent_with_a_sign(distance, text):
    assert format_distance(distance) == text


TOTALS = [
    total({1: 100.0, 2: 300.0}, {1: 125.0, 2: 300.0}),
    total({1: 5.0, 2: 5.0}, {1: 5.0, 2: 5.0}, quantity=ITAE),
    total(
        {1: 50.0, 2: 150.0}, {1: 50.0}, "hPID",
        ratios={"pybullet": {1: 0.5, 2: 0.5}, "mujoco": {1: 50.0 / 125.0}},
    ),
]  # fmt: skip


def test_every_number_is_in_the_file():
    rows = list(csv.DictReader(io.StringIO(engines_csv(TOTALS))))
    found = {
        (row["controller"], int(row["seed"]), row["quantity"], engine): float(row[engine])
        for row in rows
        for engine in ("pybullet", "mujoco")
        if row[engine]
    }
    assert found == {
        (each.controller, seed, each.quantity.key, engine): value
        for each in TOTALS
        for engine, of_seeds in each.values.items()
        for seed, value in of_seeds.items()
    }
    assert [row["distance"] for row in rows] == ["0.25", "0.0", "0.0", "0.0", "0.0", ""]


def test_the_tables_show_both_engines_and_how_far_they_lie_apart():
    summary, details = engine_grids(TOTALS, "Of two joints.")
    assert summary.rows[0] == ("paper", "PID", "+12.5 %", "-", "+0.000 %", "-", "-")
    assert details.headings[2:6] == ("PyBullet", "MuJoCo", "distance", "largest")
    assert details.rows[0][2:6] == ("200.00", "212.50", "+12.5 %", "+25.0 %")
    assert details.rows[2][-2:] == ("0.500", "0.400")
    assert {len(row) for row in details.rows} == {len(details.headings)}
    alone = engine_grids([total({1: 1.0}, {1: 2.0})], "")[1]
    assert "largest" not in alone.headings
    text = grids_text([summary, details])
    assert text.count("Of two joints.") == 2
    assert "<!-- begin engines paper -->" in grids_markdown([summary, details])
