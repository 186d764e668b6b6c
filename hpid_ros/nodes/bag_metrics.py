"""Indices of recorded bags, printed and published latched."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from hpid_ros.base.errors import SettingError, reason_of
from hpid_ros.base.records import Record, names_of, quantity
from hpid_ros.messages.selection import CLOCKS, BagSelection, parse_command_topics
from hpid_ros.metrics.alignment import ALIGNMENTS, parse_windows
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.measure import Measured, Measuring, Source, measure, measure_all
from hpid_ros.metrics.quantities import ANGLE_UNITS, Quantity, find_quantities
from hpid_ros.metrics.results import RunIndices, in_units
from hpid_ros.metrics.texts import FORMATS
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import LATCHED, steady_timer
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.status import StatusParameters, StatusPipe
from hpid_ros.robot.description import RobotDescription, robot_source

_FINISHED = "metadata.yaml"
"""A recorder writes it last: without it a bag is still being recorded, or was cut off."""


class FinishedBags:
    """Looks for finished bags below a folder, at any depth; those there already are not new."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise SettingError(f"watch must name a folder, {folder} is none")
        self._folder = folder
        self._known = set(self._sizes())
        self._before: dict[Path, int] = {}

    def new(self) -> list[Path]:
        """Return the bags that were finished by the last call and are complete now, by name."""
        sizes = {bag: size for bag, size in self._sizes().items() if bag not in self._known}
        # A file that still grows is being written this moment.
        fresh = sorted(bag for bag, size in sizes.items() if self._before.get(bag) == size > 0)
        self._known.update(fresh)
        self._before = sizes
        return fresh

    def _sizes(self) -> dict[Path, int]:
        """Return the size of each finished bag's last file."""
        sizes = {}
        for file in self._folder.rglob(_FINISHED):
            with suppress(FileNotFoundError):  # a bag may go while it is looked at
                sizes[file.parent] = file.stat().st_size
        return sizes


_LOOK_PERIOD = 0.5  # [s]


@dataclass(frozen=True)
class MetricsParameters(Record):
    """Which bags are read, how, and what is printed."""

    bags: tuple[str, ...] | None = quantity(
        "Bags to read; the first is the baseline", default=None
    )
    watch: str = quantity("Folder: report each bag finished in it", default="")
    labels: tuple[str, ...] | None = quantity(
        "One for each bag; folder names if left out", default=None
    )
    joints: tuple[str, ...] | None = quantity("Only these joints; all if left out", default=None)
    format: str = quantity(
        f"Format of the output: {', '.join(FORMATS)}", default="table", choices=tuple(FORMATS)
    )
    units: str = quantity(
        f"Unit of angles: {', '.join(ANGLE_UNITS)}", default="rad", choices=ANGLE_UNITS
    )
    indices: str = quantity("Comma-separated: paper, step, all, or keys", default="paper")
    keep_running: bool = quantity("Stay, with the result latched on ~/indices", default=False)
    namespace: str = quantity("Which of several robots", default="")
    states: tuple[str, ...] | None = quantity(
        "Topics of the joint states, each joint on one of them; found if left out", default=None
    )
    clock: str = quantity(
        f"Whose time the numbers have: {', '.join(CLOCKS)}", default="header", choices=CLOCKS
    )
    reference: str = quantity("Topic of the reference, its kind, or hold", default="auto")
    commands: str = quantity("Topic of the efforts; effort; none", default="")
    command_topics: tuple[str, ...] | None = quantity(
        "JOINT=TOPIC[INDEX] of efforts", default=None
    )
    sender: str = quantity(
        "Sender of the states, where several send the same joints: number, rate (50Hz) or layout",
        default="",
    )
    align: str = quantity(
        f"How runs are laid over each other: {', '.join(ALIGNMENTS)}",
        default="auto",
        choices=ALIGNMENTS,
    )
    windows: tuple[str, ...] | None = quantity(
        "LABEL=START[:END] of single bags, in s after the first state, instead of align",
        default=None,
    )
    robot_description: str = quantity(
        "URDF that says which joints slide, in m and N; else the bags say it", default=""
    )

    def selection(self) -> BagSelection:
        """Return what is read from a bag."""
        return BagSelection(
            joints=self.joints,
            namespace=self.namespace or None,
            states=self.states,
            clock=self.clock,
            commands=self.commands or None,
            command_topics=parse_command_topics(self.command_topics or ()),
            reference=self.reference,
            sender=self.sender or None,
        )


class BagMetrics(executor.ClosingNode):
    """Reads the bags of its parameters, prints the table, and offers the numbers.

    With ``watch`` it stays, and does the same for each bag that is finished in that folder, with
    the first of its bags as the baseline.
    """

    def __init__(self) -> None:
        super().__init__("bag_metrics")
        self._status = StatusPipe(self)
        asked = read(self, MetricsParameters)
        bags, labels, watch = asked.bags, asked.labels, asked.watch
        if not bags and not watch:
            raise SettingError(
                "the parameter bags must name at least one bag, or watch a folder; both are empty"
            )
        robot = asked.robot_description
        self._how = Measuring(
            asked.selection(),
            description=RobotDescription.load(robot_source(robot)) if robot else None,
            keeps_series=False,
            align=asked.align,
            windows=parse_windows(asked.windows or ()),
        )
        self._format, self._units = asked.format, asked.units
        self._paper = asked.indices == "paper"
        self._indices = find_quantities(asked.indices.split(","))
        self._bags = FinishedBags(Path(watch)) if watch else None
        self._baseline: RunIndices | None = None
        self._publisher = self.create_publisher(DiagnosticArray, "~/indices", LATCHED)
        if bags:
            if labels and len(labels) != len(bags):
                raise SettingError(
                    f"there must be one label for each of {len(bags)} bags, not {len(labels)}"
                )
            names = labels or [None] * len(bags)
            measured = measure_all(
                [Source(Path(bag), name) for bag, name in zip(bags, names, strict=True)], self._how
            )
            self._baseline = measured[0].run
            self._report(measured)
        if self._bags is not None:
            steady_timer(self, _LOOK_PERIOD, self._look)
            self.get_logger().info(f"watching {watch}")
        elif not asked.keep_running:
            steady_timer(self, 0.0, self.request_stop)

    def _look(self) -> None:
        assert self._bags is not None
        for bag in self._bags.new():
            try:
                self._report([measure(bag, self._label(bag), self._how)], self._baseline)
            except Exception as error:  # of one bag: the others are measured all the same
                self.get_logger().error(reason_of(error))

    def _label(self, bag: Path) -> str:
        taken = None if self._baseline is None else self._baseline.label
        return bag.name if bag.name != taken else f"{bag.parent.name}/{bag.name}"

    def _report(self, measured: Sequence[Measured], baseline: RunIndices | None = None) -> None:
        for line in (line for each in measured for line in each.defects):
            self.get_logger().warning(line)
        runs = [run for each in measured for run in each.runs]
        if baseline is not None:
            runs.insert(0, baseline)
        turned = tuple(in_units(runs, self._units))
        comparison = Comparison(turned)
        if not self._paper:
            comparison = Comparison(turned, self._indices, ())
        print(FORMATS[self._format](comparison), end="", flush=True)
        message = indices_message(comparison)
        message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(message)
        self._status.send("reported", runs=[run.label for run in runs])


def indices_message(comparison: Comparison) -> DiagnosticArray:
    """Return the indices as one status for each run and joint, and one for each run."""
    array = DiagnosticArray()
    of_all = (*comparison.indices, *comparison.norms)
    for run in comparison.runs:
        for joint in (*comparison.joint_names, None):
            quantities = of_all if joint is None else comparison.indices
            values = [
                KeyValue(
                    key=f"{quantity.symbol} [{comparison.unit(quantity, joint)}]",
                    value=_text(run, quantity, joint),
                )
                for quantity in quantities
            ]
            name = f"{run.label}: {joint or 'all joints'}"
            array.status.append(
                DiagnosticStatus(name=name, hardware_id=joint or "", values=values)
            )
    return array


def _text(run: RunIndices, quantity: Quantity, joint: str | None) -> str:
    reasons = dict.fromkeys(run.why_undefined(quantity, joint).values())
    return f"undefined: {', '.join(reasons)}" if reasons else repr(run.value(quantity, joint))


USAGE = Usage(
    "bag_metrics",
    "Computes the indices of recorded bags, prints them and publishes them latched.",
    "-p bags:=[FOLDER, ...]",
    names_of(MetricsParameters, StatusParameters),
    publishes=["~/indices"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [BagMetrics()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
