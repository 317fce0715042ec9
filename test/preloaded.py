"""Programs of the package as OS processes that do not load numpy, numba and the kernels at each start.

A server loads them once and forks a process for every program, which then runs as by ``python -m``: with arguments,
environment, working directory, output and exit status of its own. A node starts in half of the time, a command in a
quarter. rclpy is loaded by each program itself: its threads would not survive a fork.
"""

import atexit
import contextlib
import ctypes
import gc
import io
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOG = ROOT / "data" / "malaga_one_loop"
COMMAND = "hmt_slam_ros.cli.main"
"""Module of the command ``hmt_slam``."""

_SET_CHILD_SUBREAPER = 36  # <sys/prctl.h>
_READ_AT_START = ("PYTHON", "NUMBA_")
"""Beginnings of names of environment variables that count when Python or numba is loaded."""
_ENVIRONMENT = dict(os.environ)
"""The environment of the tests, before one of them changes it."""
_POLL = 0.001  # s
_LONGEST = 1 << 20
"""Most bytes of a request."""


def start(module, *arguments, **options):
    """Run a module of the package as by ``python -m``.

    :param options: of ``subprocess.Popen``: cwd, env, stdout, stderr, text, start_new_session; stdin is empty.
    :returns: a ``subprocess.Popen``.
    """
    words = [module, *map(str, arguments)]
    if _read_at_start(options.get("env") or os.environ) != _read_at_start(_ENVIRONMENT):
        return subprocess.Popen([sys.executable, "-m", *words], **options)
    return _ForkedProcess(words, **options)


def hmt_slam(*arguments, timeout=300.0, check=False):
    """Run the command in the folder of the repository, and wait for its end.

    :param check: whether it has to succeed.
    :returns: a ``subprocess.CompletedProcess`` with the text of both outputs.
    """
    with start(COMMAND, *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            output, error = process.communicate(timeout=timeout)
        finally:
            process.kill()
    assert not check or process.returncode == 0, error
    return subprocess.CompletedProcess(process.args, process.returncode, output, error)


def _read_at_start(environment):
    return {name: value for name, value in environment.items() if name.startswith(_READ_AT_START)}


class _ForkedProcess(subprocess.Popen):
    """A process that the server forked, and whose parent is this process."""

    def _execute_child(self, args, _executable, _before, _close, _pass, cwd, env, *others):
        pipes, is_session = others[3:9], others[14]
        _, _, _, output, _, error = pipes
        streams = [stream if stream != -1 else inherited for stream, inherited in ((output, 1), (error, 2))]
        request = {
            "words": args,
            "folder": str(cwd or Path.cwd()),
            "environment": dict(env or os.environ),
            "is_session": is_session,
        }
        try:
            self.pid = _server().fork(request, streams)
            self._child_created = True
        finally:
            self._close_pipe_fds(*pipes)


class _Server:
    """The server, as this process sees it."""

    def __init__(self):
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            command = [sys.executable, __file__, str(other.fileno())]
            self._process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=_ENVIRONMENT,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[other.fileno()],
            )
        atexit.register(self._close)

    def fork(self, request, streams):
        """Pid of a new child of this process.

        :param request: for ``become``, with the words of its command.
        :param streams: file descriptors of its output and its errors.
        """
        library = ctypes.CDLL(None)
        # The process that forked it ends, and this one becomes its parent.
        library.prctl(_SET_CHILD_SUBREAPER, 1)
        try:
            socket.send_fds(self._socket, [json.dumps(request).encode()], streams)
            pid = int(self._socket.recv(32) or 0)
        finally:
            library.prctl(_SET_CHILD_SUBREAPER, 0)
        assert pid, "the server of preloaded programs has ended"
        return pid

    def _close(self):
        self._socket.close()
        self._process.wait()


@cache
def _server():
    return _Server()


def load():
    """Load what commands and nodes need, but the modules that they run and rclpy: by mapping a log."""
    from hmt_slam_ros.cli.arguments import build_parser  # noqa: PLC0415  it sets the number of threads before numpy
    from hmt_slam_ros.cli.run_commands import run_map  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        run_map(build_parser().parse_args(["map", str(LOG), "--out", f"{folder}/out"]))
    # What is in the buffer would be printed by each fork.
    sys.stdout.flush()
    assert len(list(Path("/proc/self/task").iterdir())) == 1, "threads do not survive a fork"


def serve(requests):
    """Fork a process for each request; returns only in such a process, with the words of its command."""
    while True:
        content, streams, _, _ = socket.recv_fds(requests, _LONGEST, 2)
        if not content:
            os._exit(0)
        request = json.loads(content)
        receiver, sender = os.pipe()
        between = os.fork()
        if not between:
            between_pid = os.getpid()
            program = os.fork()
            if program:
                os.write(sender, str(program).encode())
                os._exit(0)
            os.close(receiver)
            os.close(sender)
            requests.close()
            while os.getppid() == between_pid:
                time.sleep(_POLL)
            become(request, streams)
            return request["words"]
        os.waitpid(between, 0)
        requests.send(os.read(receiver, 32))
        for file in (receiver, sender, *streams):
            os.close(file)


def become(request, streams):
    """Take the environment, the folder and the outputs of a new program.

    :param request: with ``environment``, ``folder``, and ``is_session``, whether it leads a new session.
    :param streams: file descriptors of its output and its errors.
    """
    if request["is_session"]:
        os.setsid()
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    for number, stream in enumerate(streams, 1):
        os.dup2(stream, number)
        os.close(stream)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.path[0] = str(ROOT)
    load()
    gc.freeze()
    module, *arguments = serve(socket.socket(fileno=int(sys.argv[1])))
    sys.argv = ["-m", *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
