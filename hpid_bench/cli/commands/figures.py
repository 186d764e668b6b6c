"""``hpid figures``: the figures of a result, for print."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from rich.console import Console

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.options import progress
from hpid_bench.cli.terminal import output_console, print_result_places
from hpid_bench.experiment.result_folder import ResultFolder
from hpid_bench.report.figures import PRINT_SAMPLES, Figure, figures_of, require_formats
from hpid_ros.base.errors import ResultExistsError, SettingError
from hpid_ros.base.names import node_sections
from hpid_ros.base.yaml_files import load_document
from hpid_ros.messages.selection import BagSelection
from hpid_ros.metrics.measure import (
    Measuring,
    Source,
    Summary,
    measure_all,
    recordings_of,
    summary,
)
from hpid_ros.metrics.task import TaskFrame
from hpid_ros.simulation.world_file import world_of

FIGURES = "figures"  # name of their folder in a result


def run(options: argparse.Namespace) -> int:
    require_formats(options.formats)
    console = output_console()
    draw_result(console, options.result, options.formats, force=options.force)
    print_result_places(console, {FIGURES: options.result / FIGURES})
    return DONE


def draw_result(
    console: Console, result: Path, formats: Sequence[str], *, force: bool = False
) -> None:
    """Draw the figures of a result into its folder."""
    found = _summary(result)
    figures = printed_figures(found)
    for figure, form in product(figures, formats):
        path = result / FIGURES / f"{figure.name}.{form}"
        if path.exists() and not force:
            raise ResultExistsError(f"{path} exists; replace it with --force")
    labels = [each.label for each in found.comparison.runs]
    with ResultFolder.reopen(result) as folder:
        for name, content in drawn_files(console, figures, labels, formats):
            folder.write(f"{FIGURES}/{name}", content)


def printed_figures(found: Summary) -> list[Figure]:
    """Return the figures of recordings, in the detail of print."""
    return figures_of(
        found.comparison,
        found.series,
        PRINT_SAMPLES,
        repeats=found.repeats,
        gains=found.gains(),
        paths=found.paths,
    )


def drawn_files(
    console: Console, figures: Sequence[Figure], labels: Sequence[str], formats: Sequence[str]
) -> Iterator[tuple[str, bytes]]:
    """Draw each figure once, and yield it in each format: the name of its file, and its bytes."""
    from hpid_bench.report.plots import drawing_bytes, drawn  # slow to import

    with progress(console, FIGURES, len(figures)) as advanced:
        for figure in figures:
            drawing = drawn(figure, labels)
            for form in formats:
                yield f"{figure.name}.{form}", drawing_bytes(drawing, form)
            advanced(figure.name)


def _summary(result: Path) -> Summary:
    """Return the numbers of a result's recordings again, with its robot's end effector."""
    bags = recordings_of(result)
    nodes = result / "nodes" / next(iter(bags))
    document = load_document(nodes / "world.yaml", SettingError)
    world, _, _, description = world_of(document.values, document)
    link = _end_effector(nodes / "bridge.yaml")
    how = Measuring(
        BagSelection(joints=world.joints),
        robot=TaskFrame(
            description, link, world.rolling_base, world.initial_positions, is_required=False
        ),
        description=description,
    )
    return summary(measure_all([Source(bag, label) for label, bag in bags.items()], how))


def _end_effector(bridge: Path) -> str:
    """Return the link that a bridge was told to report."""
    sections = node_sections(load_document(bridge, SettingError).values)
    links = [each.get("ee_link") for each in sections.values()]
    if len(links) != 1 or not isinstance(links[0], str):
        raise SettingError(f"{bridge} must have the parameter ee_link of one bridge, a text")
    return links[0]
