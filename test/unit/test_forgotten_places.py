"""Whoever adds a parameter, a choice of one or an index and forgets a place is told which.

CONTRIBUTING.md lists the places in order. Each message here names the file that lacks something.
"""

import csv
import io
import json
import math
import random
import re
import struct
from functools import cache
from typing import NamedTuple, get_args

import numpy as np
import pytest
from harness.c_loops import CLibrary, CLoop, parameters_by_chance, states_by_chance
from harness.loops import IN_EFFORT, OTHER_VALUES, STOPS, TURNS, loop_settings
from harness.places import ROOT
from harness.runs import response

from hpid_bench.cli import recording_arguments
from hpid_bench.cli.parser import Parser
from hpid_bench.tuning.export import FIELDS, GivenLoop, exported_values
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control.laws import LAWS, LawName
from hpid_ros.control.norms import NORMS
from hpid_ros.control.settings import PARAMETERS, LoopSettings
from hpid_ros.metrics import quantities
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.quantities import QUANTITIES, Quantity
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.metrics.saved_results import runs_from_mapping
from hpid_ros.metrics.texts import table_csv, table_json, table_lines
from hpid_ros.stability.closed_loop import Certificate, CertifiedSpan, unit_curve

EXPORT = "hpid_bench/tuning/export.py"
GENERATOR = "parameters_by_chance in test/harness/c_loops.py"

PAGES = {path.relative_to(ROOT): path.read_text() for path in (ROOT / "docs").rglob("*.md")}
DOCS = "\n".join(PAGES.values())
IN_CODE = re.findall(r"`([^`\n]+)`", DOCS)

# Parameters ------------------------------------------------------------------------------------

# Loops in C do without these; whatever begins so is refused unless it has its default.
NOT_IN_C = {
    "joint": "the name of the files",
    "state_clock": "a firmware has no simulated clock",
    "observer.": "export.md: refused",
    "feedforward.": "a firmware is given the reference's sample, not its motion",
    "compensation": "export.md: refused, a model takes Pinocchio",
    "model.": "of a compensation",
}
WITHOUT_UNIT = {"mu", "norm.floor", "norm.cap", "observer.degree", "model.mass_scale"}

OTHERS = {**OTHER_VALUES, **STOPS, **TURNS, **IN_EFFORT}
EXPORTED = {field.parameter: field for field in FIELDS}
CHOICES = {name: spec.choices for name, spec in PARAMETERS.items() if spec.choices}

SETTINGS = loop_settings(gains__p=40.0, gains__i=10.0, gains__d=4.0, inertia=0.1)
SEEDS = 1000  # how many settings are tried until a parameter has an effect
STATES, RETUNED_AT = 200, 60


def is_not_in_c(name):
    return any(name.startswith(each) if each[-1] == "." else name == each for each in NOT_IN_C)


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_has_description_range_and_unit(name):
    spec = PARAMETERS[name]
    assert len(spec.description) > 10, f"{name}: control/settings.py does not say what it is"
    assert spec.checked(spec.default) == spec.default, f"{name}: its default is out of its range"
    if isinstance(spec.default, float):
        is_bounded = math.isfinite(spec.minimum + spec.maximum)
        assert is_bounded, f"{name}: control/settings.py has no least and most"
        has_unit = bool(re.search(r"\[[^],]*[a-z][^],]*\]", spec.description))
        where = (
            "its text in control/settings.py has no unit, and WITHOUT_UNIT here does not have it"
        )
        assert has_unit is not (name in WITHOUT_UNIT), f"{name}: {where}"


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_stands_in_the_documentation(name):
    """On a page that says what it does, next to the table that is made of its declaration."""
    is_named = any(re.search(rf"(?<![\w.]){re.escape(name)}(?!\w)", each) for each in IN_CODE)
    assert is_named, f"{name}: no page of docs/ says what it does (as `{name}`)"


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_is_tried_with_another_value(name):
    where = "OTHER_VALUES in test/harness/loops.py has no other value of it"
    assert OTHERS.get(name, PARAMETERS[name].default) != PARAMETERS[name].default, (
        f"{name}: {where}"
    )


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_is_exported_or_refused_by_name(name):
    where = f"neither _EXPORTED of {EXPORT} nor NOT_IN_C here has it"
    assert (name in EXPORTED) is not is_not_in_c(name), f"{name}: {where}, or both do"
    if name not in EXPORTED and name not in ("joint", "state_clock"):
        beside = {"compensation": "gravity"} if name.startswith("model.") else {}
        beside |= {"model.left_wheel": "l", "model.right_wheel": "r"} if "wheel" in name else {}
        settings = SETTINGS.with_parameters({**beside, name: OTHERS[name]})
        with pytest.raises(SettingError, match=rf"elbow: ({name}|compensation) = "):
            exported_values(settings)


@cache
def drawn():
    """Return what the generator of settings for both loops draws, by parameter."""
    chance, found = random.Random(1), {}
    for _ in range(300):
        for name, value in parameters_by_chance(chance).items():
            found.setdefault(name, set()).add(value)
    return found


@pytest.mark.parametrize("name", EXPORTED)
def test_an_exported_parameter_is_drawn_for_both_loops(name):
    values = drawn().get(name, set())
    assert len(values) > 1, f"{name}: {GENERATOR} does not draw it"
    for choice in EXPORTED[name].choices:
        assert choice in values, f"{name} {choice}: {GENERATOR} does not draw it"


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return CLibrary(tmp_path_factory.mktemp("c"), SETTINGS)


class Change(NamedTuple):
    """Settings before and after one parameter, and no other, is changed; states for both."""

    before: LoopSettings
    after: LoopSettings
    states: list


def changes(name, choice):
    """Yield changes of a parameter by chance, to one choice if there are several."""
    for seed in range(SEEDS):
        chance = random.Random(seed)
        before, other = parameters_by_chance(chance), parameters_by_chance(chance)
        if choice is not None:
            other[name] = choice
        if name not in before or before[name] == other.get(name, before[name]):
            continue
        try:
            first = LoopSettings.from_parameters(before)
            then = LoopSettings.from_parameters({**before, name: other[name]})
        except HpidError:
            continue
        yield Change(first, then, list(states_by_chance(chance, STATES, before["control_period"])))


def answers(step, retune, states, then):
    """Return the bits of a loop's efforts; between two states it is retuned."""
    efforts = []
    for count, state in enumerate(states):
        if count == RETUNED_AT and then is not None:
            retune(then)
        efforts.append(struct.pack("d", step(*state)))
    return efforts


def in_python(settings, states, then=None):
    given = GivenLoop(settings)
    return answers(given.step, given.loop.retune, states, then)


def in_c(library, settings, states, then=None):
    loop = CLoop(library, settings)
    return answers(loop.step, loop.retune, states, then)


def change_with_effect(library, name, choice):
    """Return a change after which Python's loop answers otherwise, and without which C's agrees.

    What else both loops differ in is no matter of this parameter.
    """
    why_none = (
        f"{name}: of {SEEDS} settings by {GENERATOR} Python's loop answers none otherwise once it "
        "is changed: hpid_ros/control does not use it, or not after retune()"
    )
    for change in changes(name, choice):
        before, after, states = change
        unchanged = in_python(before, states)
        if in_python(before, states, after) != unchanged:
            if in_c(library, before, states) == unchanged:
                return change
            why_none = f"{name}: loop.c and hpid_ros/control differ in something else"
    return pytest.fail(why_none)


@pytest.mark.parametrize(
    ("name", "choice"),
    [(name, choice) for name, field in EXPORTED.items() for choice in field.choices or (None,)],
)
def test_a_change_of_an_exported_parameter_has_the_same_effect_in_c_and_python(
    library, name, choice
):
    if len(drawn().get(name, ())) < 2:
        pytest.fail(f"{name}: {GENERATOR} does not draw it")
    before, after, states = change_with_effect(library, name, choice)
    where = f"{name}: hpid_bench/tuning/templates/loop.c does not use it as hpid_ros/control does"
    is_alike = in_c(library, before, states, after) == in_python(before, states, after)
    assert is_alike, f"{where}, when it is changed while the loop runs"
    assert in_c(library, after, states) == in_python(after, states), f"{where}, from the start"


# Choices of a parameter: laws, norms, velocity sources, strategies, compensations ---------------

ALL_CHOICES = [(name, choice) for name, choices in CHOICES.items() for choice in choices]


@pytest.mark.parametrize(("name", "choice"), ALL_CHOICES)
def test_a_choice_stands_in_the_documentation(name, choice):
    forms = {choice, *(f"{name}{sign}{choice}" for sign in (": ", ":=", " = ", " "))}
    assert forms & set(IN_CODE), f"{name} {choice}: no page of docs/ has `{name}: {choice}`"


@pytest.mark.parametrize(("name", "choice"), ALL_CHOICES)
def test_a_choice_is_exported_or_refused_by_name(name, choice):
    field = EXPORTED.get(name)
    if name == "state_clock" or choice == PARAMETERS[name].default or field is None:
        return  # an exported loop is given its time; of other parameters: by name, above
    settings = SETTINGS.with_parameters({name: choice})
    if choice in field.choices:
        assert exported_values(settings)[name] == choice
    else:
        with pytest.raises(SettingError, match=f"{name} {choice} is not exported to C, only "):
            exported_values(settings)


def test_a_law_has_a_title():
    assert set(LAWS) == set(get_args(LawName)), "LAWS in hpid_ros/control/laws.py has others"


# Norms -----------------------------------------------------------------------------------------


def norm_named(name, degree):
    return loop_settings(norm__type=name, norm__error_scale=0.3).norm_family(degree)


@pytest.mark.parametrize("name", NORMS)
@pytest.mark.parametrize("degree", [-0.4, 0.0, 0.3])
def test_a_norm_of_arrays_is_that_of_numbers(name, degree):
    norm = norm_named(name, degree)
    points = [*np.random.default_rng(1).normal(size=(50, 2)).tolist(), (0.0, 1.0), (1.0, 0.0)]
    errors, rates = np.transpose(points)
    numbers = [norm(*point) for point in points]
    message = f"norm {name}: hpid_ros/control/norms.py gives arrays other values"
    assert norm.values(errors, rates) == pytest.approx(numbers, rel=1e-12), message
    assert norm.values(0.0, 0.0) == norm(0.0, 0.0) == 0.0, message
    around = norm.values(*unit_curve(norm, 9).T)
    assert around == pytest.approx(np.ones(around.size)), f"norm {name}: unit_curve is another's"


def test_each_norm_is_another_one():
    values = {name: norm_named(name, -0.2)(0.2, 0.7) for name in NORMS}
    made = "NORMS in hpid_ros/control/norms.py has one norm of two names"
    assert len(set(values.values())) == len(values), f"{made}: {values}"


@pytest.mark.parametrize("name", NORMS)
def test_a_certificate_of_a_norm_is_saved_and_read(name):
    norms = tuple(norm_named(name, degree) for degree in (-0.1, 0.0))
    identity = tuple(tuple(row) for row in np.eye(3).tolist())
    span = CertifiedSpan(inertia=1.0, norms=norms, shape=identity, rate=0.1)
    saved = Certificate(loop_settings(gains__p=3.0).gains, (span,)).to_mapping()
    read = Certificate.from_mapping(json.loads(json.dumps(saved))).spans[0].norms
    where = f"norm {name}: hpid_ros/control/norms.py reads another norm than it saves"
    assert [type(each) for each in read] == [type(each) for each in norms], where
    assert [each(0.2, 0.7) for each in read] == [each(0.2, 0.7) for each in norms], where


# Indices ---------------------------------------------------------------------------------------

UNITS = str.maketrans({"²": "^2", "³": "^3"})


@cache
def measured():
    """Return the numbers of a run for which all indices are defined."""
    return run_indices(response("run", damping=2.0, samples=9001))


def test_every_declared_index_is_among_all():
    declared = {each.key for each in vars(quantities).values() if isinstance(each, Quantity)}
    assert declared == set(QUANTITIES), "QUANTITIES in hpid_ros/metrics/quantities.py"


@pytest.mark.parametrize("key", QUANTITIES)
def test_an_index_is_computed_of_every_joint_and_of_all(key):
    run, quantity = measured(), QUANTITIES[key]
    where = f"{key}: hpid_ros/metrics/results.py (_joint_indices) computes none"
    for joint in (*run.joints, None):
        assert not math.isnan(run.value(quantity, joint)), f"{where}, of {joint or 'all joints'}"


@pytest.mark.parametrize("key", QUANTITIES)
def test_an_index_is_written_and_read_again(key):
    run, quantity = measured(), QUANTITIES[key]
    joints = (*run.joints, None)
    comparison = Comparison((run,), indices=(quantity,), norms=())
    rows = csv.DictReader(io.StringIO(table_csv(comparison)))
    scopes = {row["joint"] for row in rows if row["quantity"] == key and row["value"]}
    known = {name or "" for name in joints if not math.isnan(run.value(quantity, name))}
    assert scopes == known, f"{key}: hpid_ros/metrics/texts.py leaves it out of CSV"
    (read,) = runs_from_mapping(json.loads(table_json(comparison)), "a test")
    for joint in joints:
        is_read = read.value(quantity, joint) == pytest.approx(
            run.value(quantity, joint), rel=0.0, abs=0.0, nan_ok=True
        )
        assert is_read, f"{key}: hpid_ros/metrics/results.py does not read what it saved"
    assert f"{quantity.symbol} [{quantity.unit}]" in table_lines(comparison)


@pytest.mark.parametrize("key", QUANTITIES)
def test_an_index_has_a_unit_whose_angles_are_counted(key):
    unit, count = QUANTITIES[key].unit, QUANTITIES[key].angle_power
    powers = [int(power or 1) for power in re.findall(r"\brad(?:\^(\d))?", unit)]
    assert sum(powers) == count, f"{key}: angle_power in metrics/quantities.py is not of {unit}"


@pytest.mark.parametrize("key", QUANTITIES)
def test_an_index_stands_in_its_page(key):
    quantity = QUANTITIES[key]
    page = (ROOT / "docs" / "indices.md").read_text().replace("\\|", "/")
    (row,) = re.findall(rf"^\| `{key}` \| (.+) \|$", page, re.MULTILINE) or [""]
    assert row, f"{key}: docs/indices.md has no row of it"
    symbol, formula, unit, fold = (each.strip() for each in row.split("|"))
    assert formula, f"{key}: docs/indices.md has no formula of it"
    shown = unit.translate(UNITS).replace("s^½", "s^0.5"), symbol.replace("/", "|"), fold
    assert shown == (quantity.unit, quantity.symbol, quantity.fold.value), "docs/indices.md"


def test_the_help_of_hpid_metrics_names_every_index():
    """By hand, as the help imports nothing that the indices do."""
    parser = Parser(prog="hpid metrics")
    recording_arguments.metrics(parser)
    (text,) = (each.help for each in parser._actions if "--indices" in each.option_strings)
    listed = text.split(";")[0].replace(",", " ").split()
    where = "the help of --indices in hpid_bench/cli/recording_arguments.py has others"
    assert sorted(listed) == sorted(QUANTITIES), f"{where}: {set(listed) ^ set(QUANTITIES)}"
