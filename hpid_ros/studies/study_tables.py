"""The tables of a study, for a terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.analysis.quantities import ITAE, OVERSHOOT, Quantity
from hpid_ros.base.units import unit_over
from hpid_ros.report.tables.engine_tables import engine_grids
from hpid_ros.report.tables.grid import Grid, grids_markdown, grids_text
from hpid_ros.report.tables.numbers import format_ratio, format_values, slides_note
from hpid_ros.studies.batch import LAST_ERROR, PAPER_QUANTITIES
from hpid_ros.studies.claims import CLAIMS, ClaimVerdict, verdict
from hpid_ros.studies.study_plan import StudyEntry
from hpid_ros.studies.study_result import SETTLED, StudyResult
from hpid_ros.studies.sweep_result import Quartiles

NOTHING = "-"
_SHOWN = (*PAPER_QUANTITIES, OVERSHOOT)


def grids(result: StudyResult) -> list[Grid]:
    """Return all tables of a study: claims, loops, then of each experiment totals and joints.

    What was run in both engines is compared after the claims.
    """
    entries = result.plan.entries
    found = [_claims(result, label) for label in result.claimed_labels()]
    totals = result.engine_totals()
    if totals:
        found += engine_grids(totals, f"Totals over the judged joints, {_seeds(result)}.")
    found.append(_loops(result))
    for entry in entries:
        found += [_totals(result, entry), _joints(result, entry)]
    return found


def study_text(result: StudyResult) -> str:
    """Return all tables as plain text."""
    return grids_text(grids(result))


def study_markdown(result: StudyResult) -> str:
    """Return all tables as Markdown, each between comments that name it."""
    return grids_markdown(grids(result))


def _claims(result: StudyResult, label: str) -> Grid:
    evidence = result.all_evidence(label)
    rows = []
    for claim in CLAIMS:
        kind, held = verdict(claim, evidence)
        says = (
            f"{kind.value}: {', '.join(held)}" if kind is ClaimVerdict.HOLDS_WHEN else kind.value
        )
        figures = [claim.figure(each) or NOTHING for each in evidence.values()]
        rows.append((claim.text, says, *figures))
    return Grid(
        f"claims {label}",
        f"The paper's claims, {label} over the PID of the same gains",
        ("claim", "verdict", *evidence),
        tuple(rows),
        f"Medians over {_seeds(result)} of the ratio to the baseline with the same seed.",
    )


def _loops(result: StudyResult) -> Grid:
    rows = []
    every = [each for entry in result.plan.entries for each in entry.are_slides]
    heading = f"last |e| [{unit_over('rad', every)}]"
    for entry in result.plan.entries:
        for label in (entry.baseline, *entry.others):
            last = result.worst_last_error(entry, label)
            refusals = result.refusals(entry, label)
            worst = NOTHING if last is None else f"{last:.4f}"
            settled = NOTHING if last is None else _yes(last < SETTLED)
            rows.append((entry.name, label, worst, settled, _certified(refusals)))
    return Grid(
        "loops",
        "Settled and certified",
        ("experiment", "controller", heading, f"below {SETTLED:g}", "certified"),
        tuple(rows),
        "Largest error of the last second over joints and seeds. Certified: the linear law by "
        "Routh and Hurwitz, the homogeneous law at its degree, at the nominal inertia.",
    )


def _totals(result: StudyResult, entry: StudyEntry) -> Grid:
    """Return every index of the baseline, then value and ratio of each other controller."""
    headings = ["index", entry.baseline]
    for label in entry.others:
        headings += [label, "ratio"]
    rows = []
    for quantity in _SHOWN:
        own = [
            result.quartiles(entry, label, quantity) for label in (entry.baseline, *entry.others)
        ]
        if any(own):
            baseline, *values = _values(own)
            cells = [f"{quantity.symbol} [{unit_over(quantity.unit, entry.are_slides)}]", baseline]
            for label, value in zip(entry.others, values, strict=True):
                cells += [value, _ratio(result.ratios(entry, label, quantity))]
            rows.append(tuple(cells))
    wins = [_wins(result, entry, label) for label in entry.others]
    rows.append(("ITAE lower in", NOTHING, *(cell for each in wins for cell in (each, NOTHING))))
    notes = [result.note(entry, label) for label in (entry.baseline, *entry.others)]
    if any(notes):
        rows.append(("note", notes[0], *(cell for each in notes[1:] for cell in (each, ""))))
    return Grid(
        f"totals {entry.name}",
        f"{entry.name}: totals over {_enumerated(entry)}",
        tuple(headings),
        tuple(rows),
        f"Medians with quartiles over {_seeds(result)}; ratio to {entry.baseline} with the same "
        f"seed.{_slides(entry)}",
    )


def _joints(result: StudyResult, entry: StudyEntry) -> Grid:
    """Return every index's ratio joint by joint."""
    quantities: tuple[Quantity, ...] = PAPER_QUANTITIES
    unit = unit_over("rad", entry.are_slides)
    rows = [
        (
            label,
            joint,
            *(_median(result.ratios(entry, label, q, joint)) for q in quantities),
            _last(result, entry, label, joint),
        )
        for label in entry.others
        for joint in entry.joints
    ]
    return Grid(
        f"joints {entry.name}",
        f"{entry.name}: ratios to {entry.baseline}, joint by joint",
        ("controller", "joint", *(q.symbol for q in quantities), f"last |e| [{unit}]"),
        tuple(rows),
        _slides(entry).strip(),
    )


def _slides(entry: StudyEntry) -> str:
    """Return what follows a note where joints of unlike units stand beside each other."""
    note = slides_note(entry.joints, entry.experiment.slides)
    return f" {note}" if note else ""


def _last(result: StudyResult, entry: StudyEntry, label: str, joint: str) -> str:
    values = result.numbers(entry, label, LAST_ERROR, joint).values()
    return f"{max(values):.4f}" if values else NOTHING


def _values(quartiles: Sequence[Quartiles | None]) -> list[str]:
    """Return medians with quartiles, the points of a column in line."""
    numbers = iter(format_values([x for each in quartiles if each for x in each]))
    texts = [None if each is None else [next(numbers) for _ in each] for each in quartiles]
    return [NOTHING if each is None else _spread(*each) for each in texts]


def _ratio(quartiles: Quartiles | None) -> str:
    if quartiles is None:
        return NOTHING
    return _spread(*map(format_ratio, quartiles))


def _median(quartiles: Quartiles | None) -> str:
    return NOTHING if quartiles is None else format_ratio(quartiles.median)


def _spread(low: str, middle: str, high: str) -> str:
    """Return a median with its quartiles, where they can be told from it."""
    return middle if low == high else f"{middle} ({low}..{high})"


def _wins(result: StudyResult, entry: StudyEntry, label: str) -> str:
    if label == entry.baseline or result.ratios(entry, label, ITAE) is None:
        return NOTHING
    return f"{result.evidence(entry, label).joints_better} of {len(entry.joints)}"


def _certified(refusals: dict[str, str]) -> str:
    if not refusals:
        return "yes"
    joint, reason = next(iter(refusals.items()))
    more = f" and {len(refusals) - 1} more" if len(refusals) > 1 else ""
    return f"no: {joint}{more}: {reason}"


def _enumerated(entry: StudyEntry) -> str:
    if entry.joints == entry.experiment.world.joints:
        return f"all {len(entry.joints)} joints"
    return ", ".join(entry.joints)


def _seeds(result: StudyResult) -> str:
    count = result.plan.count
    return f"{count} seed{'s' * (count > 1)}"


def _yes(answer: bool) -> str:
    return "yes" if answer else "no"
