"""A run that was saved and goes on is the run that never stopped, to the byte."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from misled import make_misled
from preloaded import hmt_slam

from hmt_slam_ros.cli import run_commands
from hmt_slam_ros.cli.arguments import build_parser
from hmt_slam_ros.configuration import Configuration, load_configuration, with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.hmt_map import PARTS, RunState, read_run_state
from hmt_slam_ros.results.log_reading import describe_parameter_changes, map_folder
from hmt_slam_ros.saved_map.folder import FolderReader, FolderWriter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

LOG = Path(__file__).parents[1] / "data" / "malaga_one_loop"


def contents(directory):
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


def write_folder(directory, state):
    """A folder with nothing but the state of a run."""
    writer = FolderWriter(directory)
    for name, part in state.parts.items():
        writer.write(name, part)
    writer.finish("state", 1)
    return directory


def read(directory):
    folder = FolderReader(directory, "state", 1)
    return RunState.from_parts({name: folder.read(name, kind) for name, kind in PARTS.items()})


def same_outcome(one, other):
    for name in ("trajectory", "online_trajectory", "odometry"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.probabilities == other.probabilities
    assert [notice.text for notice in one.notices] == [notice.text for notice in other.notices]
    assert dataclasses.astuple(one.totals) == dataclasses.astuple(other.totals)


def beginning(configuration, branching):
    """A run whose TSBI makes the children of hypotheses in some way."""
    run = LockStepRun(configuration)
    run.lock_step.processes["tsbi"] = run._processes["tsbi"] = Tsbi(configuration, branching)
    return run


def compare_runs(log, folder, stops, branching=lambda: Branching, configuration=None):
    """Compare a run that stops after some records with one that does not.

    They are one until the first stop.

    :param stops: (number of the record, state of TSBI) -> whether it is saved then, and another goes on.
    :param branching: makes what makes the children of hypotheses; those that go on have the usual.
    :param configuration: of both.
    :returns: the states of TSBI where it stopped.
    """
    configuration = configuration or Configuration()
    whole = run = beginning(configuration, branching())
    stopped = []
    for number, record in enumerate(log.records()):
        whole.process_record(record)
        if run is not whole:
            run.process_record(record)
        if stops(number, run._processes["tsbi"].state):
            state = run.state
            stopped.append(state.processes["tsbi"])
            run = LockStepRun(configuration, state=read(write_folder(folder / str(number), state)))
    assert contents(write_folder(folder / "stopped", run.state)) == contents(
        write_folder(folder / "whole", whole.state)
    )
    same_outcome(*(end.recorder.finish(end.log_progress.stamps) for end in (run.finish(), whole.finish())))
    return stopped


@pytest.mark.long
def test_a_run_that_forgot_keyframes_goes_on_without_them(tmp_path):
    known = [0]

    def has_pruned(_, state):
        known.append(len(state.replica.scans))
        return known[-1] < known[-2] and len(state.hypothesis_states) == 1

    log = open_log("sim:office,size=0.7,rate=2.5,laps=3")
    assert len(compare_runs(log, tmp_path, has_pruned)) > 2


def stop_at(*conditions):
    """When to stop: when each of some conditions on TSBI's state holds for the first time."""
    open_ones = list(conditions)

    def stops(_, state):
        met = [condition for condition in open_ones if condition(state)]
        open_ones[:] = [condition for condition in open_ones if condition not in met]
        return bool(met)

    return stops


def test_a_run_that_stops_again_and_again_ends_as_one_that_does_not(tmp_path):
    """Also where two hypotheses are alive, and between an odometry reading and its scan."""
    several = stop_at(lambda state: len(state.hypothesis_states) > 1)
    stopped = compare_runs(open_log(LOG), tmp_path, lambda number, state: number % 77 == 7 or several(number, state))
    assert len(stopped) > 5
    assert max(len(state.hypothesis_states) for state in stopped) == 2


def test_a_run_in_which_closures_were_accepted_and_areas_became_one_can_stop(tmp_path):
    def has_closure(state):
        return state.replica.common.closures.any()

    def has_merged(state):
        return len(state.replica.common.areas) <= state.replica.max_area_id

    several = stop_at(lambda state: len(state.hypothesis_states) > 1, has_closure, has_merged)
    stopped = compare_runs(open_log("sim:grid,seed=4,count=2", duration=110.0), tmp_path, several)
    assert len(stopped) == 3


def test_a_run_in_which_a_closure_is_revised_can_stop_before_the_question_is_answered(tmp_path):
    log = open_log("sim:ring,seed=3,size=1.5", duration=165.0)
    (stopped,) = compare_runs(
        log, tmp_path, stop_at(lambda state: state.revised_hypotheses), lambda: make_misled(2, 0, 3.8)
    )
    assert [ends.source for ends in stopped.revised_hypotheses[0].removed_arcs] == [0]


@pytest.mark.parametrize("kind", ["lines", "by_class"])
def test_a_run_whose_local_maps_are_of_lines_can_stop(tmp_path, kind):
    """Also after the change into a second area."""
    configuration = with_changes(Configuration(), {"local_map.kind": kind})
    second = stop_at(lambda state: len(state.replica.common.areas) > 1)
    log = open_log("sim:office,seed=3,size=0.7,rate=2.5", duration=80.0)
    stopped = compare_runs(
        log, tmp_path, lambda number, state: number % 301 == 300 or second(number, state), configuration=configuration
    )
    assert len(stopped) > 2
    assert max(len(state.replica.common.areas) for state in stopped) > 1


def test_before_the_first_scan_and_after_the_last_a_run_can_stop_as_well(tmp_path):
    log = open_log(LOG, duration=3.0)
    last = sum(1 for _ in log.records()) - 1
    assert len(compare_runs(log, tmp_path, lambda number, _: number in (0, 1, last))) == 3


def test_scans_without_odometry_wait_in_the_saved_map_as_well(tmp_path):
    """A log without odometry: scans wait, until patience ends."""
    scans = [record for record in open_log(LOG, duration=8.0).records() if isinstance(record.measurement, Scan)]
    whole, run = LockStepRun(Configuration()), LockStepRun(Configuration())
    for record in scans[:3]:
        whole.process_record(record)
        run.process_record(record)
    state = run.state
    assert len(state.processes["slam"].scan_queue.scans) == 3
    run = LockStepRun(Configuration(), state=read(write_folder(tmp_path / "waiting", state)))
    for record in scans[3:]:
        whole.process_record(record)
        run.process_record(record)
    same_outcome(*(end.recorder.finish(end.log_progress.stamps) for end in (run.finish(), whole.finish())))


def test_a_run_whose_areas_end_at_doors_goes_on_with_the_openings_that_it_saw(tmp_path):
    several = stop_at(lambda state: len(state.hypothesis_states) > 1)
    configuration = with_changes(Configuration(), {"aam.area_policy": "both"})
    log = open_log("sim:office,size=0.7,rate=2.5,laps=1")
    stopped = compare_runs(
        log, tmp_path, lambda k, state: k % 150 == 149 or several(k, state), configuration=configuration
    )
    assert len(stopped) > 3


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The map of the first seconds, with parameters of its own."""
    folder = tmp_path_factory.mktemp("maps") / "first"
    options = ("--duration", 6, "--seed", 3, "--set", "aam.confirmations=3")
    hmt_slam("map", LOG, "--out", folder, *options, check=True)
    return folder


def test_the_command_goes_on_with_the_parameters_of_the_map_which_it_may_replace(first, tmp_path):
    shutil.copytree(first, tmp_path / "on")
    for folder, options in {
        "whole": ("--seed", "3", "--set", "aam.confirmations=3"),
        "on": ("--from", tmp_path / "on"),
    }.items():
        hmt_slam("map", LOG, "--out", tmp_path / folder, "--duration", 12, *options, check=True)
    assert contents(tmp_path / "whole" / "hmt_map") == contents(tmp_path / "on" / "hmt_map")
    for name in ("trajectory.tum", "trajectory_online.tum", "pmf.csv", "map.pgm", "graph.g2o"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "on" / name).read_bytes()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--set", "filter.particles=5"), "the map was made with filter.particles = 12, not with filter.particles = 5"),
        (("--duration", "3"), "malaga_one_loop ends before the last scan that the map was made of"),
    ],
)
def test_what_cannot_go_on_is_refused_and_nothing_is_left(first, tmp_path, options, sentence):
    arguments = ["map", str(LOG), "--out", str(tmp_path / "out"), "--from", str(first), *options]
    with pytest.raises(HmtSlamError, match=sentence):
        run_commands.run_map(build_parser().parse_args(arguments))
    assert list(tmp_path.iterdir()) == []


def test_a_log_that_begins_alike_and_is_another_is_refused(first):
    state, configuration = read_run_state(first / "hmt_map")
    stamps = state.log.source_stamps.copy()
    stamps[5] += 1
    state = dataclasses.replace(state, log=dataclasses.replace(state.log, source_stamps=stamps))
    with pytest.raises(HmtSlamError, match="begins as the log that the map was made of and is another"):
        run_log(open_log(LOG), configuration, state=state)


def test_a_log_that_goes_on_begins_where_it_began_and_a_further_one_anywhere():
    saved = Configuration()
    requested = with_changes(saved, {"robot.start": 2.0})
    assert describe_parameter_changes(saved, requested, further=True) is None
    with pytest.raises(HmtSlamError, match=r"made with robot\.start = 0\.0, not with robot\.start = 2\.0"):
        describe_parameter_changes(saved, requested)


def test_parameters_that_may_change_are_reported_with_both_values():
    saved = with_changes(Configuration(), {"tlca.accept_probability": 0.9, "robot.duration": 60.0})
    assert describe_parameter_changes(saved, with_changes(saved, {"robot.duration": 0.0})) is None
    reported = describe_parameter_changes(saved, with_changes(saved, {"tlca.accept_probability": 0.95, "seed": 4}))
    assert reported == (
        "goes on with seed = 4 and tlca.accept_probability = 0.95; the map was made with seed = 0 and "
        "tlca.accept_probability = 0.9"
    )


def test_the_configuration_of_a_map_serves_as_a_file_of_parameters(first):
    assert load_configuration(map_folder(first) / "configuration.yaml").seed == 3


def test_no_field_of_a_saved_map_goes_undescribed():
    text = (Path(__file__).parents[1] / "docs" / "reference" / "map_format.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    assert len(rows) > 200
    assert [row[0] for row in rows if len(row[2].strip(" |")) < 3] == []
