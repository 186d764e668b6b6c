"""What is written of an upgrade: its page, what to try first, and the comments on parameters."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hpid_bench.report.page import (
    NO_VALUE,
    Block,
    Heading,
    IndexRow,
    IndexTable,
    Paragraph,
    PlainTable,
    Properties,
    Steps,
    Title,
    page_figures,
    render_page,
)
from hpid_bench.tuning.identification.joint_identification import JointIdentification
from hpid_bench.tuning.identification.regression import COULOMB, DELAY, INERTIA, VISCOUS
from hpid_bench.tuning.upgrade_file import upgrade_text
from hpid_bench.tuning.upgrade_from_bag import BagUpgrade
from hpid_bench.tuning.upgrade_prediction import Expected, Prediction
from hpid_ros import __version__
from hpid_ros.base.names import controller_name
from hpid_ros.base.units import of_slide, unit_over
from hpid_ros.control.settings import LoopSettings
from hpid_ros.metrics.comparison import verdict
from hpid_ros.metrics.quantities import INDICES, ITAE, IVC, Quantity
from hpid_ros.metrics.texts import Cell, format_ratio, format_values
from hpid_ros.stability.margins import Margins

_HALF = 0.5


def first_steps(found: BagUpgrade, files: Mapping[str, Path]) -> list[tuple[str, Sequence[str]]]:
    """Return what to do, each in words and as lines of commands, if there are any."""
    bag, robot = (shlex.quote(str(each)) for each in (found.request.bag, found.request.robot_name))
    params = (
        f" --params {shlex.quote(str(found.request.parameters))}"
        if found.request.parameters
        else ""
    )
    payload = f" --payload {found.request.payload:g}" if found.request.payload else ""
    again = f"hpid upgrade {bag} --urdf {robot}{params}{payload}"
    if not found.prediction.is_credible:
        return [
            (
                "See which joint's efforts the model does not explain.",
                (f"hpid identify {bag} --urdf {robot} --plot efforts.png",),
            ),
            ("See whether the parameters are those that ran.", (f"hpid replay {bag}{params}",)),
        ]
    changed = [each for each in found.tried.settings if each.is_homogeneous]
    if not changed:
        return [
            ("Nothing needs to be tried: keep what you have.", ()),
            *(
                (
                    f"To see what the goal {goal} proposes, ask for it.",
                    (f"{again} --goal {goal} -o {goal}.yaml",),
                )
                for goal in found.other_goals
            ),
        ]
    first = min(
        changed,
        key=lambda each: sum(
            found.prediction.joints[each.joint][x.key].ratio for x in (IVC, ITAE)
        ),
    )
    parameters = shlex.quote(str(files["parameters"]))
    prediction_file = shlex.quote(str(files["prediction"]))
    return [
        (
            "Start the controllers from the new file with the motors off; where your own file "
            "says more, as topics or a robot_description, give that first.",
            (f"ros2 run hpid_ros joint_controllers --ros-args --params-file {parameters}",),
        ),
        (
            f"Begin with {first.joint}, which has most to gain, and with half of its degree; the "
            "others get mu 0, which is the PID that you know. Then switch the motors on.",
            [_set(each, _HALF * each.mu if each is first else 0.0) for each in changed],
        ),
        (
            "Move as the robot is going to work. If all is well, give it the whole degree, and "
            "the next joint half of its own.",
            (_set(first, first.mu),),
        ),
        (
            "Record the motion of the first recording once more, with all that was proposed.",
            (
                "ros2 run hpid_ros bag_recorder --ros-args -p bag:=after \\",
                f"    -p controllers_file:={parameters}",
            ),
        ),
        (
            "Hold the prediction against it.",
            (f"hpid upgrade --verify {bag} after --prediction {prediction_file}",),
        ),
    ]


def _set(settings: LoopSettings, degree: float) -> str:
    node = shlex.quote(f"/{controller_name(settings.joint)}")
    return f"ros2 param set {node} mu {round(degree, 3)!r}"


_DOUBTFUL = 0.1  # of an index, by which a simulated PID may miss the recorded one
_THIN_PHASE = math.radians(30.0)
_MILLISECONDS = 1e3

ASSUMED = (
    "Links are as the URDF says them, rigid, and the base stands still.",
    "The motion is the recorded one: elsewhere inertia and gravity are others.",
    "Friction is Coulomb's and viscous, the same both ways and everywhere.",
    "Efforts act as commanded, with the delay that was found; gears are stiff and have no play.",
    "Noise of the positions is white and normal, as large as in the recording.",
)
"""What every prediction stands on."""


def render_upgrade_page(found: BagUpgrade, files: Mapping[str, Path]) -> str:
    sections: dict[str, Sequence[Block]] = {
        "What was found": [*_found(found)],
        "What is assumed": [*_assumed(found)],
        "What will change": [*_changes(found)],
        "What to try first": [
            Steps(first_steps(found, files)),
            Paragraph("Keep a hand on the emergency stop.", is_soft=True),
        ],
        "Figures": (),
        "Provenance": [Properties.of("Provenance", _provenance(found, files))],
    }
    return render_page(
        f"{found.request.bag.name}: from a PID to a homogeneous PID",
        upgrade_summary(found),
        doubts(found),
        [expectations(found.prediction)],
        sections,
        page_figures(found.comparison, found.runs),
        [run.label for run in found.runs],
    )


def upgrade_summary(found: BagUpgrade) -> str:
    """Return what came of it in a sentence or two."""
    if not found.prediction.is_credible:
        return (
            "Nothing is proposed: the simulation of your PID is far from what was recorded, so "
            "the model says nothing about another law. Was the base at rest, are the masses of "
            "the URDF right, and were these the parameters that ran?"
        )
    if found.is_kept:
        text = f"Keep your PID: the goal {found.goal} gains nothing on this robot."
        for goal, ratios in found.other_goals.items():
            changes = " and ".join(_change(each, ratios[each.key]) for each in (IVC, ITAE))
            text += f" The goal {goal} would bring {changes}."
        return text
    laws = [each.is_homogeneous for each in found.tried.settings]
    which = "all joints" if all(laws) else f"{sum(laws)} of {len(laws)} joints"
    expected = " and ".join(
        _expected(each, found.prediction.total(each.key)) for each in (IVC, ITAE)
    )
    return (
        f"A homogeneous PID with your gains for {which}, goal {found.goal}: expected over all "
        f"joints {expected}."
    )


def _change(index: Quantity, ratio: float) -> str:
    share = 100.0 * (ratio - 1.0)
    if not math.isfinite(share):
        return f"an unknown change of {index.meaning} ({index.symbol})"
    return (
        f"{abs(share):.0f} % {'less' if share < 0.0 else 'more'} {index.meaning} ({index.symbol})"
    )


def _expected(index: Quantity, expected: Expected) -> str:
    ends = [100.0 * (each - 1.0) for each in (expected.low, expected.high)]
    if not all(map(math.isfinite, ends)):
        return _change(index, expected.ratio)
    return f"{_change(index, expected.ratio)} ({ends[0]:+.0f} to {ends[1]:+.0f} %)"


def doubts(found: BagUpgrade) -> list[str]:
    """Return what the prediction must be read with, one line each."""
    lines = list(found.recording.warnings)
    for name, why in found.tried.proposals.failures.items():
        lines.append(_own(found, name, f"{name} is not upgraded: {why}"))
    for joint, margins in found.margins.items():
        if isinstance(margins, str):
            line = f"{joint}: your PID has no margins on the identified joint: {margins}"
            lines.append(_own(found, joint, line))
        elif margins.phase < _THIN_PHASE:
            degrees = math.degrees(margins.phase)
            lines.append(f"{joint}: your PID has a phase margin of only {degrees:.0f} degrees")
    for index in (IVC, ITAE):
        total = found.prediction.total(index.key)
        if not (found.is_kept or total.is_certain):
            lines.append(f"{index.symbol} may rise or fall: its interval contains no change")
        off = total.fidelity - 1.0
        if not abs(off) <= _DOUBTFUL:
            lines.append(
                f"the identified model does not match the robot: your PID, simulated, has "
                f"{_change(index, 1.0 + off)} than was recorded; what is expected is a guess"
            )
    return lines


def expectations(prediction: Prediction) -> IndexTable:
    """Return what was measured and what is expected, joint by joint."""
    joints = list(prediction.joints)
    slides = [name in prediction.slides for name in joints]
    columns = [
        _cells(
            [*(prediction.joints[name][index.key] for name in joints), prediction.total(index.key)]
        )
        for index in INDICES
    ]
    rows = [
        IndexRow(name, [column[k] for column in columns])
        for k, name in enumerate([*joints, "all: sum"])
    ]
    return IndexTable(
        "What is expected of each joint",
        "joint",
        ["recorded", "expected", "ratio"],
        rows[:-1],
        rows[-1],
        [Title(index.symbol, index.unit_in("rad", slides)) for index in INDICES],
        3 * len(INDICES),
    )


def _cells(expected: Sequence[Expected]) -> list[list[Cell]]:
    texts = iter(
        format_values([value for each in expected for value in (each.before, each.after)])
    )
    return [
        [Cell(next(texts)), Cell(next(texts)), Cell(format_ratio(each.ratio), verdict(each.ratio))]
        for each in expected
    ]


def _found(found: BagUpgrade) -> Iterator[Block]:
    yield Heading("The joints")
    yield _identified(found)
    yield Paragraph(
        "± is half of the 95 % interval; in brackets: not told by the recording. Rotor: reflected "
        "inertia that the links do not have. Moves: what the motor moves along the motion, links "
        "and rotor. Fit: share of the effort's variance that is explained.",
        is_soft=True,
    )
    yield Heading("Your PID on these joints")
    yield PlainTable(
        "Your PID",
        (
            "joint",
            "p",
            "i",
            "d",
            "phase margin [°]",
            "gain margin [dB]",
            "delay margin [ms]",
            "Ms",
        ),
        [_checked(each, found.margins[each.joint]) for each in found.recording.loops],
    )
    yield Paragraph(
        "Margins of the sampled loop with the delay and friction that were found, the worst of "
        "the least and the largest inertia. Ms: peak of the sensitivity; 2 or less is usual.",
        is_soft=True,
    )
    yield Heading("Is the model right?")
    totals = [found.prediction.total(index.key).fidelity for index in INDICES]
    rows = [
        [name, *(format_ratio(known[index.key].fidelity) for index in INDICES)]
        for name, known in found.prediction.joints.items()
    ]
    rows.append(["all: sum", *map(format_ratio, totals)])
    yield PlainTable(
        "Your PID simulated, over what was recorded",
        ("joint", *(index.symbol for index in INDICES)),
        rows,
    )
    yield Paragraph(
        "Your PID, simulated on the identified robot along the same motion, over what was "
        "recorded: 1 where the model is right. What is expected is the recorded number times the "
        "ratio of two simulations, so that a part of the model's error is in both.",
        is_soft=True,
    )


def _identified(found: BagUpgrade) -> PlainTable:
    joints, moved = found.identification.joints, found.identification.moved
    slides = [each.joint in found.identification.slides for each in joints]
    inertia, friction, effort, angle = (
        unit_over(each, slides).replace("^2", "²")
        for each in ("kg m^2", "N m s/rad", "N m", "rad")
    )
    ranges = {name: f"{each.least:.3g} … {each.largest:.3g}" for name, each in moved.items()}
    noises = {name: f"{facts.noise:.2g}" for name, facts in found.pid.model.facts.items()}
    columns = {
        "joint": [each.joint for each in joints],
        f"rotor [{inertia}]": [_estimate(each, INERTIA) for each in joints],
        f"moves [{inertia}]": [ranges.get(each.joint, NO_VALUE) for each in joints],
        f"viscous [{friction}]": [_estimate(each, VISCOUS) for each in joints],
        f"Coulomb [{effort}]": [_estimate(each, COULOMB) for each in joints],
        "delay [ms]": [_estimate(each, DELAY, _MILLISECONDS) for each in joints],
        f"noise [{angle}]": [noises.get(each.joint, NO_VALUE) for each in joints],
        "fit": [
            f"{100.0 * each.explained:.1f} %" if each.is_found else NO_VALUE for each in joints
        ],
    }
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    return PlainTable("What was identified", [*columns], rows)


def _estimate(found: JointIdentification, name: str, factor: float = 1.0) -> str:
    estimate = found.estimates.get(name)
    if estimate is None:
        return NO_VALUE
    text = f"{factor * estimate.value:.3g} ± {factor * estimate.half_width:.2g}"
    return text if estimate.is_reliable else f"({text})"


def _checked(settings: LoopSettings, margins: Margins | str) -> list[str]:
    gains = [f"{value:.4g}" for value in (settings.gains.p, settings.gains.i, settings.gains.d)]
    if isinstance(margins, str):
        return [settings.joint, *gains, *["unstable"] * 4]
    return [
        settings.joint,
        *gains,
        f"{math.degrees(margins.phase):.0f}",
        f"{20.0 * math.log10(margins.gain):.1f}",
        f"{_MILLISECONDS * margins.delay:.3g}",
        f"{margins.sensitivity:.2f}",
    ]


def _assumed(found: BagUpgrade) -> Iterator[Block]:
    yield from (Paragraph(text) for text in ASSUMED)
    assumed = found.pid.model.assumptions
    rows = [(joint, _own(found, joint, line)) for joint in assumed for line in assumed[joint]]
    if rows:
        yield Heading("What the recording did not tell")
        yield PlainTable(
            "What the recording did not tell", ("joint", "assumed"), rows, is_prose=True
        )


def _changes(found: BagUpgrade) -> Iterator[Block]:
    before = {each.joint: each.to_parameters() for each in found.recording.loops}
    rows = []
    for joint, each in found.tried.proposals.found.items():
        for name, value in each.settings.to_parameters().items():
            was = before[joint][name]
            if _text(was) != _text(value):
                reason = _own(found, joint, each.reasons.get(name, ""))
                rows.append((joint, name, _text(was), _text(value), reason))
    yield PlainTable(
        "What will change", ("joint", "parameter", "was", "becomes", "why"), rows, is_prose=True
    )
    kept = [
        (joint, _own(found, joint, each.reasons["law"]))
        for joint, each in found.tried.proposals.found.items()
        if not each.settings.is_homogeneous
    ]
    if kept:
        yield Heading("What stays")
        yield PlainTable("What stays", ("joint", "why"), kept, is_prose=True)
    if found.other_goals:
        yield Heading("What other goals would bring")
        yield PlainTable(
            "What other goals would bring",
            ("goal", *(f"{index.symbol} over your PID's" for index in INDICES)),
            [
                (goal, *(format_ratio(ratios[index.key]) for index in INDICES))
                for goal, ratios in found.other_goals.items()
            ],
        )
    yield Paragraph("Gains, limits and everything that is not named stay as they were.")


def _own(found: BagUpgrade, joint: str, text: str) -> str:
    """Return a text about a joint in the joint's own units."""
    return of_slide(text) if joint in found.identification.slides else text


def _text(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _provenance(found: BagUpgrade, files: Mapping[str, Path]) -> dict[str, object]:
    run = found.recording.run
    return {
        "hpid_ros": __version__,
        "recording": str(found.request.bag),
        "length": f"{run.duration:.4g} s",
        "robot": found.request.robot_name,
        "goal": found.goal,
        **{name: path.name for name, path in files.items()},
    }


def parameter_text(found: BagUpgrade) -> str:
    """Return the parameter file of what is proposed, with what to know of each joint."""
    header = [
        f"From {found.request.bag}, goal {found.goal}.",
        *textwrap.wrap(upgrade_summary(found), 96),
        "ros2 run hpid_ros joint_controllers --ros-args --params-file THIS_FILE",
    ]
    proposed, failures = found.tried.proposals
    notes = {}
    for joint, error in failures.items():
        notes[joint] = [f"NOT upgraded: {error}."]
    for joint, each in proposed.items():
        expected = ((q.symbol, found.prediction.joints[joint][q.key]) for q in INDICES)
        ratios = (f"{name} {x.ratio:.3f} ({x.low:.2f} to {x.high:.2f})" for name, x in expected)
        line = f"Expected over the PID: {', '.join(ratios)}."
        notes[joint] = [*each.remarks, *found.pid.model.assumptions.get(joint, ()), line]
    written = [proposed.get(each.joint, each) for each in found.recording.loops]
    return upgrade_text(written, header, notes, frozenset(found.identification.slides))
