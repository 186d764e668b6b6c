"""The plan of a study, and the journal that lets it go on."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hpid_bench.experiment.batch import RunRecord, RunTask
from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_bench.experiment.result_folder import system_errors, versions
from hpid_ros.base.errors import ExperimentError, SettingError, require_known, unknown_name
from hpid_ros.base.records import Section
from hpid_ros.base.resources import ResourceError, find_resource, share_folder
from hpid_ros.base.yaml_files import load_document
from hpid_ros.simulation.settings import require_engine

JOURNAL = "runs.jsonl"

SLOW = ("bricks",)  # experiments that are in a study only when they are named


class RunKey(NamedTuple):
    """Names one run of a study."""

    experiment: str  # name of the experiment
    engine: str  # who computes the physics
    controller: str  # label of the controller
    seed: int  # the run's seed


@dataclass(frozen=True)
class StudyEntry:
    """One experiment of a study."""

    experiment: Experiment
    joints: tuple[str, ...]  # the joints that are judged, in the world's order

    @property
    def name(self) -> str:
        return self.experiment.name

    @property
    def engine(self) -> str:
        return self.experiment.world.engine

    @property
    def are_slides(self) -> tuple[bool, ...]:
        """Of each judged joint whether it slides."""
        return self.experiment.are_slides(self.joints)

    def row(self, label: str) -> tuple[str, str, str]:
        """Return the name of one of its rows: that of its runs without the seed."""
        return self.name, self.engine, label

    @property
    def digest(self) -> str:
        """SHA-256 of all that decides the numbers: experiment, robot, joints and versions."""
        all_else = json.dumps([self.joints, versions()])
        return hashlib.sha256(f"{self.experiment.digest} {all_else}".encode()).hexdigest()

    @property
    def baseline(self) -> str:
        return self.experiment.baseline

    @property
    def others(self) -> tuple[str, ...]:
        return tuple(self.experiment.controllers)[1:]


@dataclass(frozen=True)
class StudyPlan:
    entries: tuple[StudyEntry, ...]  # the experiments, of unlike names
    count: int  # seeds of each controller: the experiment's own and those that follow it

    @property
    def inputs(self) -> list[Path]:
        return [file for entry in self.entries for file in entry.experiment.inputs]

    @property
    def digests(self) -> dict[tuple[str, str], str]:
        """Of each entry, by experiment and engine."""
        return {(each.name, each.engine): each.digest for each in self.entries}

    def seeds(self, entry: StudyEntry) -> tuple[int, ...]:
        return tuple(entry.experiment.seed + k for k in range(self.count))

    def tasks(self) -> dict[RunKey, RunTask]:
        """Return all runs; those on one robot are side by side."""
        return {
            RunKey(*entry.row(label), seed): RunTask.seeded(
                entry.experiment,
                f"{entry.name} {label}",
                seed,
                entry.experiment.controllers[label],
                entry.joints,
            )
            for entry in self.entries
            for label in entry.experiment.controllers
            for seed in self.seeds(entry)
        }


def default_files() -> list[Path]:
    """Return the experiments of this package but the slow ones, the paper's first."""
    folder = share_folder() / "config" / "experiments"
    files = [path for path in sorted(folder.glob("*.yaml")) if path.stem not in SLOW]
    return sorted(files, key=lambda path: path.stem != "paper")


def is_robot_installed(file: Path) -> bool:
    """Return whether an experiment's robot is here: two of this package's are PyBullet's."""
    document = load_document(file, ExperimentError)
    robot = Section(document.values, "", ExperimentError).section("robot", {})
    try:
        find_resource(robot.text("description"), document.folders)
    except ResourceError:
        return False
    return True


def plan_study(
    files: Sequence[str | Path],
    *,
    joints: Sequence[str] = (),
    seeds: int = 20,
    engine: str | None = None,
) -> StudyPlan:
    """Read experiments and check them as a whole before anything runs."""
    if seeds < 1:
        raise SettingError(f"seeds must be at least 1, not {seeds}")
    entries: dict[str, StudyEntry] = {}
    for file in files:
        entry = _entry(load_experiment(file, engine), joints)
        require_engine(entry.engine)
        if entry.name in entries:
            other = entries[entry.name].experiment.path
            raise SettingError(f"two experiments are called {entry.name!r}: {other} and {file}")
        entries[entry.name] = entry
    if not entries:
        raise SettingError("a study needs at least one experiment")
    known = {joint for each in entries.values() for joint in each.experiment.world.joints}
    require_known("joint", joints, known)
    return StudyPlan(tuple(entries.values()), seeds)


def _entry(experiment: Experiment, joints: Sequence[str]) -> StudyEntry:
    if len(experiment.controllers) < 2:
        raise SettingError(f"{experiment.path}: there is nothing to compare with the baseline")
    if not joints:
        return StudyEntry(experiment, experiment.judged)
    named = tuple(joint for joint in experiment.world.joints if joint in joints)
    if not named:
        names = unknown_name("joint", joints[0], experiment.world.joints)
        raise SettingError(f"{experiment.path}: {names}")
    return StudyEntry(experiment, named)


@dataclass(frozen=True)
class JournalEntry:
    """What is kept of one run, and of what it was."""

    key: RunKey  # which run
    digest: str  # SHA-256 of all that decides its numbers but the seed
    record: RunRecord

    def line(self) -> str:
        """Return the entry as one line of JSON, with a checksum of all else in it."""
        saved = {**self.key._asdict(), "sha256": self.digest, **self.record._asdict()}
        return json.dumps({**saved, "crc32": zlib.crc32(json.dumps(saved).encode())})

    @classmethod
    def parse(cls, line: str) -> JournalEntry:
        saved = json.loads(line)
        if saved.pop("crc32") != zlib.crc32(json.dumps(saved).encode()):
            raise ValueError("not what was written")
        key = RunKey(*(saved.pop(name) for name in RunKey._fields))
        return cls(key, saved.pop("sha256"), RunRecord(**saved))


def read_journal(path: Path) -> list[JournalEntry]:
    """Return the entries of a journal; a last line that was cut off is left out."""
    if not path.is_file():
        return []
    with system_errors(f"cannot read {path}"):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    entries = []
    for number, line in enumerate(lines, 1):
        try:
            entries.append(JournalEntry.parse(line))
        except (ValueError, AttributeError, LookupError, TypeError, RecursionError):
            if number == len(lines):
                break
            raise SettingError(
                f"{path}: line {number} is damaged, or of an earlier version; delete the line, "
                "and its run is repeated"
            ) from None
    return entries


def kept_records(plan: StudyPlan, folder: Path) -> dict[tuple[object, ...], RunRecord]:
    """Return the runs in a folder that are still those of the plan and did not fail."""
    digests, wanted = plan.digests, plan.tasks()
    journal = folder / JOURNAL
    records: dict[tuple[object, ...], RunRecord] = {}
    for entry in read_journal(journal):
        key, record = entry.key, entry.record
        if key not in wanted or record.failure:
            continue
        if entry.digest != digests[key.experiment, key.engine]:
            continue
        if records.setdefault(key, record) != record:
            raise SettingError(
                f"{journal}: {key.experiment} {key.controller} seed={key.seed} in "
                f"{key.engine} is there with other numbers than before; one of the two is "
                "wrong, or made on a machine that computes differently"
            )
    return records
