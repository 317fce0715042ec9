"""Programs of the package as OS processes that do not load numpy, numba and the kernels at each start.

A server loads them once and forks a process for every program, which then runs as by ``python -m``: with arguments,
environment, working directory, output and exit status of its own. A command starts in a quarter of the time, and a node
in less: rclpy and the classes of nodes are also loaded where ROS is installed. Nothing is initialized: a program makes
its own participant of DDS, in its own domain.
"""

import atexit
import contextlib
import ctypes
import gc
import importlib.util
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
import warnings
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOG = ROOT / "data" / "malaga_one_loop"
COMMAND = "hmt_slam_ros.cli.main"
"""Module of the command ``hmt_slam``."""

_SET_CHILD_SUBREAPER = 36  # <sys/prctl.h>
# Messages check the names and types of their fields, which they do not by default.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

_READ_AT_START = ("PYTHON", "NUMBA_", "ROS_PYTHON_CHECK_FIELDS", "RMW_IMPLEMENTATION")
"""Beginnings of names of environment variables that count when Python, numba, messages or rclpy are loaded."""
_ENVIRONMENT = dict(os.environ)
"""The environment of the tests, before one of them changes it."""
_TRACING_PREFIXES = ("ust_", "lttng_ust_")
"""Beginnings of names of the functions of LTTng, before 2.13 and since."""
_TRACING_THREADS = 2
_SIGNAL_SET = 128  # bytes of a sigset_t
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
    """Load what commands and nodes need, but the modules that they run: by mapping a log.

    :returns: tracing that goes on in each program.
    """
    from hmt_slam_ros.cli.arguments import build_parser  # noqa: PLC0415  it sets the number of threads before numpy
    from hmt_slam_ros.cli.run_commands import run_map  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        run_map(build_parser().parse_args(["map", str(LOG), "--out", f"{folder}/out"]))
    assert _thread_count() == 1, "threads do not survive a fork"
    if not importlib.util.find_spec("rclpy"):
        return _Tracing([])
    tracing = _load_nodes()
    assert _thread_count() == 1, "threads do not survive a fork"
    return tracing


def _load_nodes():
    """Load rclpy, the classes of all nodes, and what converts their messages.

    :returns: the tracing of rclpy, in a process without its threads.
    """
    from rclpy.type_support import check_for_type_support  # noqa: PLC0415  only where there is ROS

    libraries = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "/liblttng" in line}
    tracing = _Tracing(map(ctypes.CDLL, sorted(libraries)))
    tracing.leave_threads()
    from hmt_slam_ros.process_table import node_names, node_row, resolve_class  # noqa: PLC0415  they load rclpy

    for name in node_names():
        resolve_class(node_row(name).node_class)
    modules = [module for name, module in sys.modules.items() if name.endswith((".msg", ".srv"))]
    for kind in [kind for module in modules for kind in vars(module).values()]:
        if hasattr(type(kind), "_TYPE_SUPPORT"):
            check_for_type_support(kind)
    return tracing


class _Tracing:
    """The tracing of rclpy (LTTng), which starts two threads when it is loaded.

    It has functions for a program that forks: they stop it, and start other threads in the new process.
    """

    def __init__(self, libraries):
        """Find its functions.

        :param libraries: that are loaded; without tracing none has them.
        """
        names = [(library, prefix) for library in libraries for prefix in _TRACING_PREFIXES]
        found = [(library, prefix) for library, prefix in names if hasattr(library, f"{prefix}before_fork")]
        self._functions = [
            (getattr(library, f"{prefix}before_fork"), getattr(library, f"{prefix}after_fork_child"))
            for library, prefix in found[:1]
        ]
        self._signals = ctypes.create_string_buffer(_SIGNAL_SET)

    def leave_threads(self):
        """Go on in a process without its threads, while this one waits for its end."""
        if not self._functions:
            return
        assert _thread_count() <= 1 + _TRACING_THREADS, "threads do not survive a fork"
        for before_fork, _ in self._functions:
            before_fork(self._signals)
        with warnings.catch_warnings(action="ignore"):  # of threads
            without_threads = os.fork()
        if without_threads:
            os._exit(os.waitstatus_to_exitcode(os.waitpid(without_threads, 0)[1]))

    def go_on(self):
        """Start its threads in a process that was forked without them."""
        for _, after_fork in self._functions:
            after_fork(self._signals)


def _thread_count():
    return len(list(Path("/proc/self/task").iterdir()))


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
    tracing = load()
    gc.freeze()
    module, *arguments = serve(socket.socket(fileno=int(sys.argv[1])))
    tracing.go_on()
    sys.argv = ["-m", *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
