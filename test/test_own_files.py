"""What the package writes is whole or not there, and what others wrote is never removed."""

import errno
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from hmt_slam_ros import own_files
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.own_files import ScratchFolder, write_file

_KILLED = """
import os
import signal
import sys
from pathlib import Path

from hmt_slam_ros.own_files import ScratchFolder

scratch = ScratchFolder(Path(sys.argv[1]), Path(sys.argv[1]).parent)
(scratch.path / "new").mkdir()
os.kill(os.getpid(), signal.SIGKILL)
"""


def names(directory):
    return sorted(path.name for path in directory.iterdir())


def test_a_file_is_replaced_and_nothing_is_left_beside_it(tmp_path):
    for content in (b"one", b"two"):
        write_file(tmp_path / "map.png", content)
    assert (names(tmp_path), (tmp_path / "map.png").read_bytes()) == (["map.png"], b"two")


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    def fail(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    write_file(tmp_path / "map.png", b"one")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(HmtSlamError, match=r"map\.png cannot be written \(No space left on device\): make room, or"):
        write_file(tmp_path / "map.png", b"two")
    assert (names(tmp_path), (tmp_path / "map.png").read_bytes()) == (["map.png"], b"one")


def test_what_a_killed_process_left_of_a_file_goes_and_what_others_left_stays(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    gone, alive, other = f".a.partial-{ended.pid}", f".a.partial-{os.getppid()}", f".b.partial-{ended.pid}"
    for name in (gone, alive, other):
        (tmp_path / name).write_text("half")
    write_file(tmp_path / "a", b"whole")
    assert names(tmp_path) == sorted([alive, other, "a"])


def test_the_scratch_folder_of_a_killed_process_goes_and_every_other_stays(tmp_path):
    target = tmp_path / "out"
    killed = subprocess.run([sys.executable, "-c", textwrap.dedent(_KILLED), str(target)], check=False)
    assert killed.returncode < 0
    assert len(names(tmp_path)) == 1
    alive = ScratchFolder(tmp_path / "out", tmp_path)
    assert names(tmp_path) == [alive.path.name]
    (tmp_path / ".out.partial-backup").mkdir()
    (tmp_path / ".out.partial-backup" / "notes.txt").write_text("precious")
    (tmp_path / ".out.partial-made").mkdir()
    (tmp_path / ".out.partial-made" / "lock").touch()
    another = ScratchFolder(tmp_path / "out", tmp_path)
    another.remove()
    assert names(tmp_path) == sorted([alive.path.name, ".out.partial-backup", ".out.partial-made"])
    alive.remove()
    assert names(tmp_path) == [".out.partial-backup", ".out.partial-made"]


@pytest.mark.parametrize("line", ["self.path.mkdir(", "self._lock = os.open(", "fcntl.flock(", "after"])
def test_a_program_that_a_signal_ends_between_any_two_lines_leaves_no_scratch_folder(tmp_path, line):
    ended = """
        import inspect, sys
        from pathlib import Path
        from hmt_slam_ros.own_files import ScratchFolder

        lines, first = inspect.getsourcelines(ScratchFolder.__init__)
        ends_before = first + 1 + next((k for k, line in enumerate(lines) if sys.argv[2] in line), len(lines))

        def trace(frame, event, _):
            if frame.f_code is ScratchFolder.__init__.__code__ and event == "line" and frame.f_lineno == ends_before:
                raise SystemExit(143)
            return trace

        sys.settrace(trace)
        scratch = ScratchFolder(Path(sys.argv[1]), Path(sys.argv[1]).parent)
        sys.settrace(None)
        raise SystemExit(143)
    """
    arguments = [str(tmp_path / "out"), line]
    run = subprocess.run([sys.executable, "-c", textwrap.dedent(ended), *arguments], check=False)
    assert run.returncode == 143
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_moved_in_two_steps_leaves_the_old_one(tmp_path, monkeypatch):
    """A file system that cannot exchange two names, and a disk that fails at the second step."""
    for name in ("book", "new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "page").write_text(name)
    rename = Path.rename

    def fail_for_new(path, target):
        if path.name == "new":
            raise OSError(errno.EIO, "Input/output error")
        return rename(path, target)

    monkeypatch.setattr(own_files, "_exchange", lambda one, other: False)
    monkeypatch.setattr(Path, "rename", fail_for_new)
    with pytest.raises(OSError, match="Input/output error"):
        own_files.replace_folder(tmp_path / "new", tmp_path / "book")
    assert (tmp_path / "book" / "page").read_text() == "book"
