"""Surroundings of graphs whose processes are killed and frozen: UDP on this machine's loopback.

Experiments have shared memory alone, the closed mode, and there Fast DDS can lose its discovery
for good: when a process is killed or frozen, all others open the common port anew, but keep their
former places in the list by which a listener's death is noticed
(``SharedMemManager::Listener::operator=`` does not move ``listener_index_``; so in 2.14.5 and in
all later versions seen). Dead listeners then stay unnoticed, the port fills up, and a process that
is started later is found by nobody. docs/faults.md tells more.
"""

from __future__ import annotations

from pathlib import Path

from hpid_bench.experiment.processes import closed_environment
from hpid_ros.base.names import PROFILE_FILES

LOOPBACK = Path(__file__).with_name("loopback.xml")


def loopback_environment(domain: int) -> dict[str, str]:
    """Return the environment of a graph in which processes may be killed and frozen."""
    environment = closed_environment(domain)
    del environment["FASTDDS_BUILTIN_TRANSPORTS"]
    return environment | dict.fromkeys(PROFILE_FILES, str(LOOPBACK))
