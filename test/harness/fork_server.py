"""Processes of nodes that are forked from one that has imported them already, as ``Popen``.

The suite starts hundreds: they come from the fork server that runs on the graph use, and are the
same processes in every other respect.
"""

import os
import signal
import subprocess
import sys

from hpid_bench.experiment.forking import Beginning, ForkServer
from hpid_bench.experiment.processes import module_of

_NODES = ("hpid_ros.nodes.", "hpid_bench.live.")


class ForkedPopen(subprocess.Popen):
    """``Popen`` whose children of the form ``python -m hpid_ros.nodes.NAME`` are forked."""

    def _execute_child(self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest):
        is_node = args[:2] == [sys.executable, "-m"] and args[2].startswith(_NODES)
        if not (is_node and isinstance(preexec_fn, Beginning)):
            super()._execute_child(
                args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest
            )
            return
        pipes = rest[3:9]
        stdin, _, _, stdout, _, stderr = pipes
        standard = zip((stdin, stdout, stderr), (0, 1, 2), strict=True)
        files = {number: number if file == -1 else file for file, number in standard}
        files |= {number: number for number in pass_fds}
        server = ForkServer.of(dict(os.environ))
        self.pid = server.fork(args[2], args[3:], env, preexec_fn, files, cwd and str(cwd))
        self._child_created = True
        self._close_pipe_fds(*pipes)


def run_node(executable, arguments, **options):
    """Run a node that ends by itself and return what it said, as ``subprocess.run`` does."""
    command = [sys.executable, "-m", module_of(executable), "--ros-args", *arguments]
    process = ForkedPopen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(os.environ),
        preexec_fn=Beginning(signal.SIGKILL),
        **options,
    )
    with process:
        try:
            said = process.communicate(timeout=60)
        finally:
            process.kill()
    return subprocess.CompletedProcess(command, process.returncode, *said)
