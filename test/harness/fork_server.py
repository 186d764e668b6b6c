"""Processes of nodes that are forked from one that has imported them already.

A node spends most of the processor time of its start on imports. In the suite a server imports
once, before any thread and any middleware is there, and forks a process for each node. It is the
same process in every other respect: a child of the test, in a session of its own, with the
environment, arguments, files and exit code of ``python -m hpid_ros.nodes.NAME``.
"""

import atexit
import ctypes
import gc
import importlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time

from hpid_ros.experiment.processes import Beginning, module_of
from hpid_ros.nodes.core import status

_PR_SET_CHILD_SUBREAPER = 36
_LIBC = ctypes.CDLL(None)
_NODES = ("hpid_ros.nodes.", "hpid_ros.live.")
_ENDING = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)
_LARGEST = 1 << 18  # [byte], of a request


class ForkedPopen(subprocess.Popen):
    """``Popen`` whose children of the form ``python -m hpid_ros.nodes.NAME`` are forked.

    The kernel makes a child of the test of a process whose parent has ended, as long as the test
    is the reaper of what it descends from: so it can wait for it like for any other child.
    """

    _server = None

    def _execute_child(self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest):
        is_node = args[:2] == [sys.executable, "-m"] and args[2].startswith(_NODES)
        if not (is_node and isinstance(preexec_fn, Beginning)):
            super()._execute_child(
                args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest
            )
            return
        if ForkedPopen._server is None:
            ForkedPopen._server = _started()
        pipes = rest[3:9]
        stdin, _, _, stdout, _, stderr = pipes
        request = {
            "module": args[2],
            "arguments": args[3:],
            "environment": env,
            "ignored": [int(each) for each in _ENDING if signal.getsignal(each) == signal.SIG_IGN],
            "core": resource.getrlimit(resource.RLIMIT_CORE),
            "folder": cwd and str(cwd),
            "beginning": [int(preexec_fn.parting), preexec_fn.is_batch],
            "numbers": [0, 1, 2, *pass_fds],
        }
        standard = zip((stdin, stdout, stderr), (0, 1, 2), strict=True)
        own = [number if file == -1 else file for file, number in standard]
        files = [*own, *pass_fds]
        _LIBC.prctl(_PR_SET_CHILD_SUBREAPER, 1)
        try:
            socket.send_fds(ForkedPopen._server, [json.dumps(request).encode()], files)
            self.pid = int(ForkedPopen._server.recv(64))
        finally:
            _LIBC.prctl(_PR_SET_CHILD_SUBREAPER, 0)
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


def _started():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST)
    command = [sys.executable, "-m", "harness.fork_server", str(theirs.fileno())]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(each for each in sys.path if each),
        "OPENBLAS_NUM_THREADS": "1",  # threads do not survive a fork
    }
    server = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment)
    theirs.close()

    def end():
        ours.close()
        server.wait()

    atexit.register(end)
    return ours


def _serve(channel):
    """Fork a process for each request; return in the process what it asks for, at the end None."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it goes when the test goes
    while True:
        data, files, _, _ = socket.recv_fds(channel, _LARGEST, 16)
        if not data:
            return None
        request = json.loads(data)
        importlib.import_module(request["module"])
        gc.freeze()
        between = os.fork()
        if between:
            os.waitpid(between, 0)
            for file in files:
                os.close(file)
            continue
        between = os.getpid()
        if os.fork():
            os._exit(0)
        while os.getppid() == between:
            time.sleep(1e-4)
        channel.send(str(os.getpid()).encode())
        channel.close()
        return request, files


def _become(request, files):
    """Make this process what Popen would have made of it."""
    os.setsid()
    for number in _ENDING:  # as exec leaves them: ignored ones stay so
        is_ignored = int(number) in request["ignored"]
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if is_ignored else usual)
    Beginning(signal.Signals(request["beginning"][0]), request["beginning"][1])()
    resource.setrlimit(resource.RLIMIT_CORE, tuple(request["core"]))
    spare = [os.dup(file) for file in files]
    above = max([*spare, *request["numbers"]]) + 1
    spare = [os.dup2(file, above + index) for index, file in enumerate(spare)]
    for number in range(3, above):
        if number not in request["numbers"]:
            try:
                os.close(number)
            except OSError:
                continue
    for file, number in zip(spare, request["numbers"], strict=True):
        os.dup2(file, number, inheritable=True)
        os.close(file)
    if request["folder"]:
        os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.argv = [request["module"], *request["arguments"]]


if __name__ == "__main__":
    wanted = _serve(socket.socket(fileno=int(sys.argv[1])))
    if wanted:
        _become(*wanted)
        importlib.reload(status)  # it has looked which pipes its process was given
        sys.exit(importlib.import_module(wanted[0]["module"]).main())
