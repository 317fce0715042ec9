"""Topology in a second process: the same messages and states as in lock-step, however far metric SLAM is ahead."""

import os
from dataclasses import fields, is_dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, LocalEstimate, RealTimePose
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.offline.pipeline import PipelinedRun, ReadAhead, TopologyWorker
from hmt_slam_ros.open_log import open_log

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"
DISPLACED = "sim:office,seed=3,size=0.7,laps=1,carried=0.35,to=0.08,turned=120"


KINDS = (Keyframe, Hypotheses, ClosureDecision, LocalEstimate, RealTimePose)


def content(value):
    """The whole content of a message or state, as bytes and plain values; which parts are one object does not count."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return type(value).__name__, [content(getattr(value, field.name)) for field in fields(value) if field.init]
    if isinstance(value, dict):
        return [(content(key), content(part)) for key, part in value.items()]
    if isinstance(value, list | tuple):
        return [content(part) for part in value]
    return sorted(value) if isinstance(value, set | frozenset) else value


def process(run, log):
    """The messages of a run in the order of delivery, and its state at the end of the log."""
    received, deliver = [], run.lock_step.deliver

    def observe(message):
        if isinstance(message, KINDS):
            received.append(content(message))
        return deliver(message)

    run.lock_step.deliver = observe
    for record in run.unread_records(open_log(log)):
        run.process_record(record)
    state = content(run.state)
    run.finish()
    return received, state


class Chance:
    """Whether topology has answered, by chance instead of by time."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)

    def __get__(self, worker, owner):
        return self.random.random() < 0.1


@pytest.fixture(scope="module")
def in_lock_step():
    results = {}

    def run(log, configuration):
        if log not in results:
            results[log] = process(LockStepRun(configuration), log)
        return results[log]

    return run


@pytest.mark.parametrize(("log", "seed"), [(BUNDLED, 0), (BUNDLED, 1), (DISPLACED, 2)])
def test_all_messages_and_states_are_those_of_lock_step(in_lock_step, monkeypatch, log, seed):
    monkeypatch.setattr(TopologyWorker, "has_answer", Chance(seed))
    configuration = load_configuration()
    expected, state = in_lock_step(log, configuration)
    with PipelinedRun(configuration) as run:
        received, found = process(run, log)
        record = run.speculation
    assert [message[0] for message in received] == [message[0] for message in expected]
    assert all(message == other for message, other in zip(received, expected, strict=True))
    assert found == state
    assert record.scans > 50
    assert record.confirmed > 10
    assert sum(record.refuted.values()) > 1
    assert record.refuted["area"] > 0
    assert 0 < record.repeated < record.scans
    assert record.dropped_seconds > 0.0


class Faulty:
    """A process that raises an error, or whose OS process ends."""

    state = None

    def handle(self, message):
        if message.sequence:
            os._exit(3)
        raise HmtSlamError("the map is full")


def test_what_topology_raises_is_raised_and_its_end_is_one_sentence():
    worker = TopologyWorker({"aam": Faulty()})
    worker.send([Hypotheses(0, ())])
    with pytest.raises(HmtSlamError, match="the map is full") as caught:
        worker.receive()
    assert "in handle" in caught.value.__notes__[0]
    worker.send([Hypotheses(1, ())])
    with pytest.raises(HmtSlamError, match=r"the process of topology ended with status 3: .*--jobs 1"):
        worker.receive()
    worker.close()


def test_a_fault_of_the_log_comes_at_its_turn():
    def records():
        yield from (0, 1)
        raise HmtSlamError("the log is damaged")

    ahead = ReadAhead(records())
    assert [ahead.peek(number) for number in (0, 1, 2, 2)] == [0, 1, None, None]
    assert list(islice(ahead, 2)) == [0, 1]
    assert ahead.peek(0) is None
    with pytest.raises(HmtSlamError, match="the log is damaged"):
        next(ahead)
