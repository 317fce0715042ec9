"""A message on which a process raises an error is set aside: the process is rebuilt, also after a kill."""

import json
import signal

import numpy as np
import pytest
import sixth_process
from sixth_process import FATAL, NAME, POISON

from hmt_slam_ros.process_table import topic_of

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")


class Node:
    """The node of the sixth process, and what it publishes."""

    def __init__(self, listener, start, recovery):
        from diagnostic_msgs.msg import DiagnosticArray  # noqa: PLC0415  only where there is ROS
        from rcl_interfaces.msg import Log  # noqa: PLC0415
        from std_msgs.msg import String  # noqa: PLC0415

        from hmt_slam_ros.ros import topics  # noqa: PLC0415

        self._listener, self._start, self._recovery = listener, start, recovery
        self._lines = listener.subscribe(Log, "/rosout", topics.CHAIN_HISTORY)
        self.notices = listener.subscribe(String, topic_of("Notice"), topics.CHAIN)
        self._reports = listener.subscribe(DiagnosticArray, topics.DIAGNOSTICS, topics.STREAM)
        self._decisions = listener.node.create_publisher(String, topic_of("ClosureDecision"), topics.CHAIN)
        self.process = None

    def start(self):
        count = len(self._reports)
        self.process = self._start(NAME, recovery=self._recovery)
        self.until(lambda: len(self._reports) > count)

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        return self.process.communicate()[1]

    def send(self, sequence, ambiguity=0.0):
        from std_msgs.msg import String  # noqa: PLC0415  only where there is ROS

        from hmt_slam_ros.messages.documents import encode  # noqa: PLC0415
        from hmt_slam_ros.messages.messages import ClosureDecision  # noqa: PLC0415

        message = ClosureDecision(sequence, ambiguity=np.diag([ambiguity, 0.0, 0.0]))
        self._decisions.publish(String(data=encode(message)))

    def until(self, condition):
        self._listener.until(condition, alive=[self.process])

    def values(self):
        """The last diagnostics."""
        return {one.key: one.value for report in self._reports[-1:] for one in report.status[0].values}

    def has_logged(self, sentence):
        """Whether a line of the log begins so."""
        self.until(lambda: any(line.msg.startswith(sentence) for line in self._lines))
        return True

    def last_count(self):
        """The last sentence of the process."""
        return json.loads(self.notices[-1].data)["text"] if self.notices else ""


@pytest.fixture
def node(tmp_path, monkeypatch, listener, start):
    """The node, not started yet."""
    sixth_process.add_to_programs(tmp_path, monkeypatch)
    return Node(listener, start, tmp_path / "recovery")


def test_a_message_that_brings_a_process_to_a_fault_is_set_aside_kept_and_named(node, tmp_path):
    node.start()
    node.send(0)
    node.send(1, POISON)
    node.send(1)
    node.until(lambda: node.last_count() == "decisions: 2")
    node.until(lambda: node.values().get("refused on ClosureDecision, set aside") == "1")
    (kept,) = (tmp_path / "recovery" / f"{NAME}.quarantine").glob("*.jsonl")
    assert json.loads(kept.read_text())["value"]["sequence"] == 1
    assert node.has_logged(
        f"{NAME} could not handle a ClosureDecision (ZeroDivisionError('a fault of the program')) and goes on without "
        f"it: report the fault with {kept}"
    )
    # The process was rebuilt as it was before, and so it is after a kill.
    assert "ZeroDivisionError" in node.kill()
    node.start()
    node.send(2)
    node.until(lambda: node.last_count() == "decisions: 3")
    assert len(list(kept.parent.glob("*.jsonl"))) == 1
    node.kill()


def test_rebuilds_are_bounded(node):
    node.start()
    node.send(0)
    for _ in range(4):
        node.send(1, POISON)
    node.until(lambda: node.values().get("refused on ClosureDecision, set aside") == "4")
    node.send(1)
    # The fourth one left its trace: the process counted it.
    node.until(lambda: node.last_count() == "decisions: 3")
    assert "could not be rebuilt" in node.kill()


def test_a_process_that_cannot_be_rebuilt_goes_on_as_it_is_and_asks_for_a_restart(node, tmp_path):
    node.start()
    node.send(0)
    node.send(1, FATAL)
    node.until(lambda: node.values().get("refused on ClosureDecision, set aside") == "1")
    node.send(1)
    node.until(lambda: node.last_count() == "decisions: 3")
    assert node.has_logged(
        f"{NAME} could not be rebuilt (MemoryError('no room')) and goes on as it is: restart all nodes"
    )
    node.kill()


def poison(folder, change, name=NAME):
    """Append an entry to the journal of a killed node: its last one, changed."""
    (generation,) = (path for path in (folder / name).iterdir() if path.name.isdecimal())
    journal = max(generation.glob("*.jsonl"), key=lambda path: int(path.stem))
    last = json.loads(journal.read_text().splitlines()[-1])
    with journal.open("a") as file:
        for entry in change(last):
            file.write(json.dumps(entry) + "\n")


def test_a_journal_with_inputs_that_are_none_is_recovered_again_and_again(node, tmp_path):
    node.start()
    node.send(0)
    node.send(1)
    node.until(lambda: node.last_count() == "decisions: 2")
    node.kill()

    def change(last):
        yield {**last, "value": {**last["value"], "sequence": "two"}}
        yield {**last, "value": {"of": "an older version"}}
        yield {**last, "kind": "Odometry", "value": {"stamp": -5, "pose": last["value"]["ambiguity"]}}

    poison(tmp_path / "recovery", change)
    for k in (2, 3):
        node.start()
        node.send(k)
        node.until(lambda k=k: node.last_count() == f"decisions: {k + 1}")
        if k == 2:
            node.until(lambda: node.values().get("refused on the journal") == "3")
            assert node.has_logged("the journal is left out: ")
        node.kill()


@pytest.mark.long
def test_a_journal_with_an_input_on_which_the_process_fails_is_recovered_once_and_left_behind(node, tmp_path):
    node.start()
    node.send(0)
    node.send(1)
    node.send(2, 1.0)
    node.until(lambda: node.last_count() == "decisions: 3")
    node.kill()
    node.notices.clear()
    (generation,) = (path for path in (tmp_path / "recovery" / NAME).iterdir() if path.name.isdecimal())
    arrays = generation / "0.bin"
    content = arrays.read_bytes()
    assert content.count(np.float64(1.0).tobytes()) == 1
    # As if an older version had not failed on it.
    arrays.write_bytes(content.replace(np.float64(1.0).tobytes(), np.float64(POISON).tobytes()))
    node.start()
    node.until(lambda: node.values().get("refused on ClosureDecision, set aside") == "1")
    node.send(2)
    node.until(lambda: node.last_count() == "decisions: 3")
    assert "goes on without it" in node.kill()
    node.start()
    node.send(3)
    node.until(lambda: node.last_count() == "decisions: 4")
    assert "goes on without it" not in node.kill()


def test_a_folder_that_a_running_node_uses_is_left_alone(node, start, tmp_path):
    node.start()
    node.send(0)
    node.until(lambda: node.last_count() == "decisions: 1")
    second = start(NAME, recovery=tmp_path / "recovery")
    error = second.communicate(timeout=60)[1]
    assert second.returncode == 2
    assert "is in use by another node: give each system a folder recovery of its own" in error
    node.send(1)
    node.until(lambda: node.last_count() == "decisions: 2")
    node.kill()
    node.start()
    node.send(2)
    node.until(lambda: node.last_count() == "decisions: 3")
