"""One controller's end is nobody else's: kills, freezes and restarts beside seven that go on."""

import os
import subprocess
import sys
from collections import Counter

import pytest

from benchmarks.episodes import OTHERS_AT_MOST, run_episode, sines, undisturbed
from benchmarks.faults import main as faults_command
from benchmarks.soak import GROWTH_AT_MOST, private_bytes, soak, warm_up_of
from benchmarks.soak import main as soak_command
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.forking import ForkServer

pytestmark = pytest.mark.alone

SOAK_MINUTES = float(os.environ.get("HPID_SOAK_MINUTES", "1"))


@pytest.mark.timeout(1200)
def test_the_others_go_on_and_a_restarted_controller_takes_over(tmp_path, faults):
    experiment = load_experiment(sines(tmp_path, 12.0).path, engine="mujoco")
    episode = run_episode(experiment, undisturbed(experiment), tmp_path / "run", seed=3)
    kinds = Counter(fault.kind for fault in episode.faults)
    for kind, count in kinds.items():
        faults.count(f"controllers hit beside seven others: {kind}", count)
    faults.count("samples lost by the other controllers", episode.unplanned)
    assert episode.faults
    assert episode.broken() == []
    assert 0.0 < episode.others < OTHERS_AT_MOST


@pytest.mark.skipif(SOAK_MINUTES == 0.0, reason="HPID_SOAK_MINUTES is 0")
@pytest.mark.timeout(60.0 * SOAK_MINUTES + 300.0)
def test_minutes_at_full_rate_leave_memory_flat_and_nothing_behind(tmp_path, faults):
    ForkServer.of(os.environ)  # the suite's, and no leftover
    result = soak(SOAK_MINUTES, warm_up_of(SOAK_MINUTES), 1, tmp_path)
    for name, count in result.retunes.items():
        faults.count(f"soak: sets of parameters {name}", count)
    faults.count("soak: controllers hit", len(result.faults))
    faults.count("soak: states", result.states)
    faults.count("soak: samples missed outside of the faults", len(result.unplanned))
    assert len(result.growth) >= 10  # eight controllers, bridge and recorder
    assert max(result.growth.values()) < GROWTH_AT_MOST
    assert result.retunes["accepted"] > 0
    assert result.retunes["refused"] > 0
    assert result.broken() == []


def test_a_process_that_grows_is_seen():
    """Or a flat memory would say nothing."""
    code = (
        "import sys\nkept = []\nfor _ in sys.stdin: kept.append(b'x' * 2**21); print(flush=True)"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with child:
        child.stdin.write(b"\n")
        child.stdin.flush()
        child.stdout.readline()
        before = private_bytes(child.pid)
        child.stdin.write(b"\n")
        child.stdin.flush()
        child.stdout.readline()
        assert 2**21 <= private_bytes(child.pid) - before < 2**22
        child.stdin.close()
    with pytest.raises(ProcessLookupError):
        private_bytes(child.pid)


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (faults_command, ["--minutes", "0"]),
        (soak_command, ["--minutes", "1", "--warm-up", "2"]),
    ],
)
def test_unusable_arguments_are_one_line_and_exit_code_two(capsys, command, arguments):
    assert command(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--minutes must be positive" in line
