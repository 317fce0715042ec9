"""A robot that wakes up somewhere in a map maps around itself, until it is recognized where it is."""

import numpy as np
import pytest

from benchmark.awakening import FAR, awakened, mapped
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs import open_log
from hmt_slam_ros.offline.runtime import Run
from hmt_slam_ros.processes.messages import Carried
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.topology.closure_search import ClosureSearch
from hmt_slam_ros.topology.unknown import tells_nothing, unknown

WORLD = "sim:office,seed=3,size=0.7"
OFF = np.array([5.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def office():
    return mapped(WORLD)


def carried(office, records, scans):
    """A run that woke up in a map and read so many scans."""
    run = Run(Configuration(), state=office.state)
    run.lock_step.feed(Carried())
    for record in records:
        run.read(record)
        scans -= isinstance(record.measurement, Scan)
        if not scans:
            break
    return run


def test_it_begins_a_new_area_to_which_an_arc_leads_that_tells_nothing(office):
    before = Replica.of(office.state.tsbi.replica)
    run = carried(office, office.records[office.starts[60] :], 10)
    replica = Replica.of(run.state.tsbi.replica)
    (leaf,) = run.recorder.hypotheses[max(run.recorder.hypotheses)].leaves
    assert leaf.lost
    assert leaf.area not in before.maps[before.best].area_ids()
    hybrid_map = replica.maps[leaf.hypothesis]
    (beside,) = hybrid_map.neighbours(leaf.area)
    assert tells_nothing(hybrid_map.arc(beside, leaf.area))
    for area in before.maps[before.best].area_ids():
        assert hybrid_map.keyframes(area).keys() == before.maps[before.best].keyframes(area).keys()


@pytest.mark.parametrize("share", [0.15, 0.4, 0.7])
def test_it_is_recognized_where_it_is(office, share):
    found = awakened(office, office.starts[int(share * len(office.starts))])
    assert found.right
    assert not found.wrong
    assert found.found <= FAR


def test_it_is_not_believed_to_be_where_one_look_alone_finds_it(office, monkeypatch):
    """Every other look finds it 5 m off."""
    looks, found = [], ClosureSearch.everywhere

    def off_at_times(search, *asked):
        looks.append(found(search, *asked))
        if len(looks) % 2:
            return looks[-1]
        moved = [
            fit._replace(mode=fit.mode._replace(pose=PoseGaussian(fit.mode.pose.mean + OFF, np.eye(3))))
            for fit in looks[-1].found
        ]
        return looks[-1]._replace(found=tuple(moved))

    monkeypatch.setattr(ClosureSearch, "everywhere", off_at_times)
    run = carried(office, office.records[office.starts[60] :], 150)
    (leaf,) = run.recorder.hypotheses[max(run.recorder.hypotheses)].leaves
    assert sum(look.best is not None and look.best[1] > 0.9 for look in looks) >= 3
    assert leaf.lost


@pytest.mark.parametrize("seed", [4, 5, 6, 7])
def test_in_a_building_that_it_does_not_know_it_stays_lost(office, seed):
    run = carried(office, open_log(f"sim:grid,seed={seed},size=0.7").records(), 150)
    assert all(leaf.lost for leaf in run.recorder.hypotheses[max(run.recorder.hypotheses)].leaves)


def test_scans_are_counted_on_and_odometry_begins_anew(office):
    run = carried(office, office.records[office.starts[60] :], 25)
    assert run.state.slam.scans == office.state.slam.scans + 25
    assert run.state.slam.dropped == 0


def test_an_arc_that_tells_nothing_is_told_from_the_least_certain_one_between_areas():
    assert tells_nothing(unknown(np.array([3.0, 4.0, 1.0])))
    assert not tells_nothing(PoseGaussian(np.zeros(3), np.diag([100.0, 100.0, 1.0]) ** 2))
