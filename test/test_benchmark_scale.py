"""The lattices that scale is measured in, the robot that leaves them and comes back, and the requirements."""

import numpy as np
import pytest

from benchmark.lattice import FIRST_KEYFRAME, PER_AREA, SPACING, Lattice, LatticeScans, make_stops, scan_at
from benchmark.report import VALIDATION, document_marks
from benchmark.scale import ALL, Cut, cost_of_scans, cut_requirement, growth_requirement, measured_cuts
from benchmark.scale_events import event_requirements, event_table, time_events
from benchmark.scale_maps import state_of, time_saving, weigh_areas
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.process_table import process_names


def test_events_are_timed_in_a_map_that_is_older_and_of_a_robot_that_is_lost_in_it(monkeypatch):
    monkeypatch.setattr("benchmark.scale_events._EXCURSIONS", 4)
    monkeypatch.setattr("benchmark.scale_events._LENGTH", 2)
    times = time_events(Lattice(4, 6), Configuration())
    assert [len(own) for own in times.values()] == [4 * 5 * 7, 5 * 3]
    assert all((own > 0.0).all() for own in times.values())
    # Searches of the map take far longer than events without.
    assert np.median(times["lost in the map"]) > 5.0 * np.median(times["driven beside the map and back into it"])
    assert len(event_requirements(times)) == 4
    assert "lost in the map" in event_table(times)


def test_every_crossing_lies_where_the_arcs_place_it():
    lattice = Lattice(4, 3)
    hybrid_map = lattice.hybrid_map()
    found = shortest_path_beliefs(hybrid_map, 0)
    assert sorted(found) == list(range(12))
    for placed in lattice.poses():
        assert np.allclose(found[placed.area].mean, placed.pose.mean)
    assert sorted(hybrid_map.neighbors(5)) == [1, 4, 6, 9]
    assert all(len(hybrid_map.keyframes(area)) == PER_AREA for area in found)


def test_the_shared_scans_are_those_of_the_keyframes_poses():
    hybrid_map, scans = Lattice(2, 2).hybrid_map(), LatticeScans()
    for keyframe, pose in hybrid_map.keyframes(3).items():
        assert keyframe >= FIRST_KEYFRAME
        elsewhere = scan_at(pose + np.array([5 * SPACING, -2 * SPACING, 0.0]), 0, 7)
        assert np.allclose(scans[keyframe].ranges, elsewhere.ranges, atol=0.1)


def test_a_way_stops_at_even_distances_and_looks_ahead():
    way = list(make_stops([(0, 0), (1, 0), (1, -1)]))
    assert np.allclose(np.diff([stop.pose[0] for stop in way[:5]]), 1.6)
    assert [stop.last for stop in way] == 2 * [False, False, False, False, True]
    assert np.allclose(way[5].pose, [SPACING, -SPACING + 3.2, -0.5 * np.pi])


def test_cuts_out_of_a_map_and_back_in_are_counted():
    cuts = measured_cuts(Lattice(6, 2), Configuration(), excursions=1)
    assert len(cuts) == 10
    assert all(cut.ms > 0.0 for cut in cuts)
    assert not any(cut.compared for cut in cuts[:4])
    assert max(cut.compared for cut in cuts) > 0


def test_a_scan_has_a_cost_in_every_process():
    costs = cost_of_scans([Lattice(4, 2)], Configuration(), repeats=1)
    assert list(costs) == [8]
    assert set(costs[8]) == set(process_names())
    assert all(0.0 < cost < 1000.0 for cost in costs[8].values())


def test_what_a_stored_area_takes_is_poses_arcs_and_scans():
    area = weigh_areas(Lattice(10, 10))
    assert 1.0 < area.graph < 8.0
    assert PER_AREA * 4 * 181 / 1e3 < area.scans < 20.0
    assert area.whole == area.graph + area.scans


def test_the_longest_cut_and_the_growth_of_a_scans_cost_are_scored():
    cuts = [Cut(30.0, 0, 1, 0.0), Cut(101.0, 3, 2, 0.0)]
    assert not cut_requirement(10_000, cuts).is_met
    assert cut_requirement(100_000, cuts).is_met
    scans = {10: {"slam": 1.0, "rtl": 1.0}, 1000: {"slam": 1.09, "rtl": 1.2}}
    assert growth_requirement("slam", scans).is_met
    assert not growth_requirement("rtl", scans).is_met
    assert growth_requirement(ALL, scans).value == pytest.approx(0.145)
    assert not growth_requirement(ALL, scans).is_met


@pytest.mark.parametrize("kind", ["scale"])
def test_the_document_has_a_place_for_the_tables(kind):
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks(kind))


def test_a_map_is_saved_and_loaded_with_all_that_was_mapped():
    state = state_of(Lattice(4, 3), Configuration())
    assert len(state.processes["slam"].replica.common.areas) == len(state.processes["aam"].graphs) == 12
    assert (
        len(state.recorder.replica.scans)
        == len(state.processes["slam"].live_hypotheses[0].keyframe_covariances.keyframes)
        == 12 * PER_AREA
    )
    assert len({scan.ranges.tobytes() for scan in state.processes["tlca"].replica.scans.values()}) == 12 * PER_AREA
    saved = time_saving(Lattice(4, 3), Configuration())
    assert saved.areas == 12
    assert saved.megabytes > 12 * PER_AREA * 181 * 4 / 1e6
    assert saved.load_map > 0.0
    assert saved.whole == saved.save + saved.load > 0.0
