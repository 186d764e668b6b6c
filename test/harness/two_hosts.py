"""Two hosts on one machine: network namespaces, joined by a cable that is a pair of devices."""

import os
import subprocess
from contextlib import contextmanager
from pathlib import Path

_HOLD = ("unshare", "--net", "--mount", "--ipc", "--", "sh", "-c")
_DEVICES = ("cable", "plug")
_SETUP = "mount -t tmpfs none /dev/shm && ip link set lo up && echo up && cat"


class HostsError(Exception):
    """This system permits no such hosts."""


@contextmanager
def two_hosts():
    """Yield for each host the command in front of what runs there.

    Raises:
        HostsError: They are not permitted here, or a tool is missing.
    """
    holders = []
    try:
        for _ in range(2):
            try:
                holder = subprocess.Popen(
                    [*_HOLD, _SETUP],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                )
            except FileNotFoundError as error:
                raise HostsError(str(error)) from error
            holders.append(holder)
            if not holder.stdout.readline():
                raise HostsError("no network namespaces")
        first, second = (holder.pid for holder in holders)
        first_device, second_device = _DEVICES
        inside = [_inside(first), _inside(second)]
        _run(
            *inside[0], *f"ip link add {first_device} type veth peer name {second_device}".split()
        )
        _run(*inside[0], "ip", "link", "set", second_device, "netns", str(second))
        for prefix, device, address in zip(inside, _DEVICES, (1, 2), strict=True):
            _run(*prefix, "ip", "address", "add", f"10.99.0.{address}/24", "dev", device)
            _run(*prefix, "ip", "link", "set", device, "up", "multicast", "on")
            _run(*prefix, "ip", "route", "add", "224.0.0.0/4", "dev", device)
        yield inside
    finally:
        for holder in holders:
            holder.communicate()


def pull(prefixes):
    """Let nothing through any more; the devices do not notice, as behind a switch."""
    for prefix, device in zip(prefixes, _DEVICES, strict=True):
        _run(*prefix, "tc", "qdisc", "replace", "dev", device, "root", "blackhole")


def plug(prefixes):
    """Let everything through again."""
    for prefix, device in zip(prefixes, _DEVICES, strict=True):
        _run(*prefix, "tc", "qdisc", "delete", "dev", device, "root")


def network_environment(environment):
    """Return the environment of nodes that talk through the network alone."""
    return {
        **environment,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }


def _inside(pid):
    return ("nsenter", f"--target={pid}", "--net", "--mount", f"--wd={Path.cwd()}", "--")


def _run(*command):
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"  # where tc is, whatever a user's path says
    environment = {**os.environ, "PATH": path}
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if run.returncode != 0:
        raise HostsError(f"{' '.join(command)}: {run.stderr.strip()}")
