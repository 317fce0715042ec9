"""Mapping of a whole log, in one OS process or in two; the results are the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.logs.records import Log
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.offline.lock_step import LockStepRun, RunResult
from hmt_slam_ros.offline.pipeline import PipelinedRun
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.sensors import Scan


def run_log(
    log: Log,
    configuration: Configuration,
    progress: Callable[[int], None] | None = None,
    abstraction: Callable[[Configuration], Process] | None = None,
    state: RunState | None = None,
    on_state: Callable[[RunState], None] | None = None,
    compact_record: bool = False,
    jobs: int = 1,
) -> RunResult:
    """Map a whole log.

    :param log: the newest log of the state, or a further one.
    :param progress: called with the number of scans read, after each scan.
    :param abstraction: makes the process that replaces the AAM.
    :param state: state from which the run continues, with the first record that was not read.
    :param on_state: called with the state after the last record, before ``EndOfLog``.
    :param jobs: OS processes; more than one where no other AAM is given, of which two have work.
    :param compact_record: whether the recorder replaces messages by a record, which saves memory in long runs.
    :raises HmtSlamError: where the log is faulty.
    """
    with ExitStack() as stack:
        if jobs > 1 and abstraction is None:
            run: LockStepRun = stack.enter_context(PipelinedRun(configuration, state))
        else:
            run = LockStepRun(configuration, abstraction, state)
        for record in run.unread_records(log):
            run.process_record(record)
            if compact_record:
                run.recorder.compact()
            if progress and isinstance(record.measurement, Scan):
                progress(run.scans_read)
        if on_state:
            on_state(run.state)
        return run.finish()
