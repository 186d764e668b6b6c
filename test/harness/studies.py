"""Comparisons and studies, as a user runs them; processes, and waiting for what they do."""

import json
import os
import threading
import time
from contextlib import suppress
from pathlib import Path

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.main import main

ARM = ["arm_joint_1", "arm_joint_2", "arm_joint_3"]


def compared(file, folder, *options):
    """Run ``hpid compare`` in this process, and return the folder of its result."""
    assert main(["compare", str(file), "--in-process", "-o", str(folder), *options]) == DONE
    return folder


def study(files, folder, *options, seeds=2):
    """Run ``hpid study`` in this process, or where the options say, and return its exit code."""
    where = () if "--scheduler" in options else ("--jobs", "1")
    arguments = [*files, "--seeds", seeds, *where, "-o", folder, *options]
    return main(["study", *map(str, arguments)])


def wait_until(is_true, within=120.0, what="it"):
    """Wait for a condition."""
    deadline, pause = time.monotonic() + within, threading.Event()
    while not is_true():
        assert time.monotonic() < deadline, f"waited {within} s in vain for {what}"
        pause.wait(0.02)


def children_of(parent=None):
    """Return the processes that have this parent."""
    found = []
    for file in Path(f"/proc/{parent or os.getpid()}/task").glob("*/children"):
        with suppress(OSError):  # a thread that has just ended
            found += map(int, file.read_text().split())
    return found


def is_alive(process):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False


def saved(folder):
    """Return what a study found."""
    return json.loads((folder / "study.json").read_text())
