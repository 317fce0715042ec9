"""A process is one row of the table: a sixth one takes part in both runtimes, and all others expect it."""

import json
import socket
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from urllib.request import urlopen

import pytest
import sixth_process
from sixth_process import NAME, CounterState

from hmt_slam_ros.process_table import RUN_NODE, node_command, process_names, topic_of

WORLD, SECONDS = "sim:office,size=0.7,rate=2.5", 30.0


@pytest.fixture
def with_row(tmp_path, monkeypatch):
    """All Python programs that are started from here on have the row in the table from the beginning."""
    sixth_process.add_to_programs(tmp_path, monkeypatch)


def run_with_row(function, *arguments):
    """Call a function of this file in a program of its own."""
    code = f"import test_process_table; test_process_table.{function}(*{arguments!r})"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr


def map_and_go_on(folder):
    from hmt_slam_ros.configuration import Configuration  # noqa: PLC0415  when the row is in the table
    from hmt_slam_ros.offline.lock_step import LockStepRun  # noqa: PLC0415
    from hmt_slam_ros.offline.run import run_log  # noqa: PLC0415
    from hmt_slam_ros.open_log import open_log  # noqa: PLC0415
    from hmt_slam_ros.results.hmt_map import MapWriter, read_run_state  # noqa: PLC0415

    states, configuration = [], Configuration()
    recorder = run_log(open_log(WORLD, duration=SECONDS), configuration, on_state=states.append).recorder
    counted = states[0].processes[NAME].decisions
    assert counted == len(recorder.decisions) > 0
    assert (NAME, f"decisions: {counted}") in recorder.notices
    writer = MapWriter(Path(folder))
    writer.write_state(states[0])
    writer.finish(configuration)
    again, _ = read_run_state(Path(folder))
    assert LockStepRun(configuration, state=again).state.processes[NAME] == CounterState(counted)


def test_lock_step_delivers_its_messages_and_a_saved_map_has_its_state(with_row, tmp_path):
    run_with_row("map_and_go_on", str(tmp_path / "hmt_map"))


def examine_without_it():
    from hmt_slam_ros.doctor.running import RunningSystem, Topic, running_findings  # noqa: PLC0415  as above

    others = tuple(name for name in process_names() if name != NAME)
    topics = defaultdict(lambda: Topic(1, ("driver",)))
    texts = [finding.text for finding in running_findings(RunningSystem(1.0, topics, others, (), (), {}, {}))]
    assert any(f"Of the nodes, {NAME} is missing" in text for text in texts), texts


def test_the_doctor_misses_it(with_row):
    run_with_row("examine_without_it")


def test_the_page_expects_it(with_row, start):
    pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    page = start("view", port=port)
    while "the page is at" not in page.stderr.readline():
        assert page.poll() is None
    with urlopen(f"http://127.0.0.1:{port}/news", timeout=10) as stream:
        snapshot = json.loads(next(line for line in stream if line.startswith(b"data: ")).removeprefix(b"data: "))
    assert NAME in {row["name"] for row in snapshot["nodes"]}


def test_a_node_of_it_answers_and_saves_its_part(with_row, listener, start, tmp_path):
    from std_msgs.msg import String  # noqa: PLC0415  only where there is ROS

    from hmt_slam_ros.messages.documents import SaveRequest, SaveResponse, decode, encode  # noqa: PLC0415
    from hmt_slam_ros.messages.messages import ClosureDecision, Notice  # noqa: PLC0415
    from hmt_slam_ros.ros import topics  # noqa: PLC0415

    notices = listener.subscribe(String, topic_of("Notice"), topics.CHAIN)
    answers = listener.subscribe(String, topic_of("SaveResponse"), topics.CHAIN)
    decisions = listener.node.create_publisher(String, topic_of("ClosureDecision"), topics.CHAIN)
    requests = listener.node.create_publisher(String, topic_of("SaveRequest"), topics.CHAIN)
    start(NAME)
    for number in range(3):
        decisions.publish(String(data=encode(ClosureDecision(number))))
    listener.until(lambda: len(notices) == 3)
    assert decode(notices[-1].data, Notice).text == "decisions: 3"
    listener.until(requests.get_subscription_count)
    folder = tmp_path / ".map.partial-1" / "new"
    folder.mkdir(parents=True)
    requests.publish(String(data=encode(SaveRequest(1, 3, str(folder), shutdown=False))))
    listener.until(lambda: answers)
    answer = decode(answers[0].data, SaveResponse)
    assert (answer.process, answer.error) == (NAME, "")
    assert (folder / f"{NAME}.json").is_file()


def test_every_node_is_started_by_its_name():
    assert node_command(NAME) == ["-m", RUN_NODE, NAME]
    assert NAME not in process_names()
