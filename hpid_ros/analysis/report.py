"""The report of a comparison: one web page that needs nothing beside itself.

The answer stands first, then the table, the figures, what the controllers were set to, what
went missing, and where the numbers come from. Every text that is not this module's own is
escaped.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape

from hpid_ros.analysis.comparison import Comparison, answer
from hpid_ros.analysis.report_facts import (
    Parameters,
    losses,
    parameter_tables,
    provenance_table,
    scrolling,
)
from hpid_ros.analysis.report_figures import page_figures
from hpid_ros.analysis.report_style import STYLE_SHEET
from hpid_ros.analysis.report_tables import index_table, legend, norm_table
from hpid_ros.analysis.series import RunSeries, SeriesError


def render_report(
    comparison: Comparison,
    runs: Sequence[RunSeries],
    provenance: Mapping[str, object],
    parameters: Parameters,
) -> str:
    """Return the report as the text of an HTML file.

    Args:
        comparison: The numbers.
        runs: The runs that the numbers are of, in the same order.
        provenance: Where they come from: versions, seed, hash, command; may be nested.
        parameters: What each controller was set to, by run, joint and parameter.

    Raises:
        SeriesError: If the runs are not those of the comparison.
    """
    labels = [run.label for run in runs]
    if labels != [run.label for run in comparison.runs]:
        raise SeriesError(
            f"the report's runs are {', '.join(labels)}, but the comparison's are "
            f"{', '.join(run.label for run in comparison.runs)}"
        )
    others = " and ".join(labels[1:])
    title = f"{others} against {labels[0]}" if others else labels[0]
    sections = {
        "Indices": [index_table(comparison), norm_table(comparison), legend(comparison)],
        "Figures": _figures(runs),
        "Parameters": parameter_tables(parameters),
        "Losses": losses(runs),
        "Provenance": [provenance_table(provenance)],
    }
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="answer">{escape(answer(comparison))}</p>',
        *_losses_warning(runs),
    ]
    for heading, parts in sections.items():
        body += [f"<section>\n<h2>{heading}</h2>", *parts, "</section>"]
    return _page(title, "\n".join(body))


def _figures(runs: Sequence[RunSeries]) -> Iterator[str]:
    for name, caption, svg in page_figures(runs):
        yield (
            f'<figure id="{name}">{scrolling(caption, svg)}'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )


def _losses_warning(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield one line for each run that lost something: its numbers are not the whole truth."""
    for run in runs:
        lost = {joint: loss for joint, loss in run.losses.items() if loss}
        if lost:
            unanswered = sum(loss.unanswered_states for loss in lost.values())
            repeated = sum(loss.repeated_commands for loss in lost.values())
            text = (
                f"{run.label} lost samples in {', '.join(lost)}: unanswered states {unanswered}, "
                f"repeated commands {repeated}; see Losses."
            )
            yield f'<p class="warning">{escape(text)}</p>'


def _page(title: str, body: str) -> str:
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE_SHEET}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )
