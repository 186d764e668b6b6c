"""Shared memory that is full is named: Fast DDS says nothing of it (Fast-DDS#2790, #3536)."""

import subprocess
import sys

import pytest

MOUNTS = ("unshare", "--mount", "--", "sh", "-c")


def with_shared_memory(size, command):
    """Run a command where /dev/shm has another size."""
    code = f'mount -t tmpfs -o size={size} none /dev/shm && exec "$@"'
    return subprocess.run(
        [*MOUNTS, code, "sh", *command], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("size", "line"),
    [("64k", "/dev/shm is full: 0 MB are free"), ("18m", "/dev/shm may have been full: ")],
)
def test_a_comparison_says_that_shared_memory_is_full(experiment_file, tmp_path, size, line):
    """With 18 MB some nodes can be made, and the next one ends with an error of the middleware."""
    try:
        if with_shared_memory("1m", ["true"]).returncode:
            pytest.skip("this system permits no mount namespace")
    except FileNotFoundError:
        pytest.skip("there is no unshare")
    file, result = experiment_file(duration=0.1), tmp_path / "result"
    hpid = (sys.executable, "-m", "hpid_bench.cli.main", "compare", file, "--output", result)
    run = with_shared_memory(size, hpid)
    (told,) = (each for each in run.stderr.splitlines() if each.startswith("hpid: "))
    assert run.returncode == 1
    assert line in told
    assert "--shm-size" in told
    assert result.exists() == (size == "18m")
