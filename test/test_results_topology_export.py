"""The topology as GraphML, read back by networkx and by the standard library."""

import json
from pathlib import Path
from xml.etree import ElementTree

import networkx as nx
import numpy as np
import pytest
from test_results_output_folder import COVARIANCE, MAP_T_AREA_1, make_recorder, write

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.area_classes import AreaClassifier
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.landmarks.landmarks import CONCAVE_CORNER, OPENING
from hmt_slam_ros.landmarks.portals import Portal
from hmt_slam_ros.results import export
from hmt_slam_ros.results.export import export_topology
from hmt_slam_ros.results.hmt_map import read_saved_map
from hmt_slam_ros.results.output_folder import check_replaceable
from hmt_slam_ros.submap.local_mapping import LocalMapping

NUMBERS = ("x", "y", "theta", "xx", "xy", "xt", "yy", "yt", "tt")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("exported")
    write(directory, make_recorder())
    return directory


def numbers(attributes: dict) -> list[float]:
    return [attributes[name] for name in NUMBERS]


def belief_numbers(belief) -> list[float]:
    return [*belief.mean.tolist(), *belief.covariance[np.triu_indices(3)].tolist()]


def test_areas_and_arcs_read_back_as_the_map_has_them(folder: Path) -> None:
    graph = nx.read_graphml(export_topology(folder)[0], node_type=int)
    saved = read_saved_map(folder / "hmt_map")
    hybrid_map = saved.replica.maps[saved.replica.best_hypothesis]
    kinds = AreaClassifier(LocalMapping(saved.configuration))
    assert graph.is_directed()
    assert sorted(graph) == hybrid_map.area_ids() == [0, 1]
    for area, attributes in graph.nodes.items():
        assert numbers(attributes) == belief_numbers(saved.area_poses[area])
        assert attributes["keyframes"] == len(hybrid_map.keyframes(area))
        assert attributes["robot"] is (area == 1)
        keyframes = hybrid_map.keyframes(area)
        kind = kinds.classify([saved.replica.scans[k] for k in keyframes], np.array(list(keyframes.values())))
        assert attributes.get("hallway") == (None if kind is None else kind.probability)
    arcs = {(a, b): arc for a, b, arc in hybrid_map.all_arcs()}
    assert set(graph.edges) == set(arcs) == {(0, 1)}
    attributes = graph.edges[0, 1]
    assert numbers(attributes) == belief_numbers(arcs[0, 1].pose)
    assert numbers(attributes)[:3] == pytest.approx(MAP_T_AREA_1)
    assert [attributes[name] for name in ("xx", "yy", "tt")] == pytest.approx(np.diag(COVARIANCE))
    assert attributes["closure"] is True
    assert attributes["portals"] == 0


def test_portals_stand_at_their_arcs_and_landmarks_in_a_file_of_their_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    belief = PoseGaussian(np.array([1.0, 2.0, 0.5]), np.diag([0.01, 0.02, 0.03]))
    portal = Portal((0, 1), belief, belief.inverse(), 0.9, 0.05, 0.8, 2)
    door = Landmark(OPENING, belief, 0.9, 0.05, Existence(0.8, detections=4, misses=1))
    corner = Landmark(CONCAVE_CORNER, belief, 0.0, 0.0, Existence(0.7))
    monkeypatch.setattr(LandmarkMap, "observe", lambda found, *_, **__: setattr(found, "landmarks", [door, corner]))
    monkeypatch.setattr(export, "find_portals", lambda *_: (portal,))
    graph_file, landmarks_file, _ = export_topology(folder)
    attributes = nx.read_graphml(graph_file, node_type=int).edges[0, 1]
    assert [attributes[f"portal_{name}"] for name in NUMBERS] == belief_numbers(belief)
    assert (attributes["portals"], attributes["portal_width"], attributes["portal_existence"]) == (1, 0.9, 0.8)
    document = json.loads(landmarks_file.read_text())
    assert set(document["areas"]) == {"0", "1"}
    first, second = document["areas"]["1"]
    assert (first["kind"], numbers(first), first["width"]) == ("opening", belief_numbers(belief), 0.9)
    assert (first["existence"], first["seen"], first["missed"]) == (0.8, 4, 1)
    assert second["kind"] == "corner" and "width" not in second
    (only,) = document["portals"]
    assert (only["areas"], only["passages"], only["existence"]) == ([0, 1], 2, 0.8)
    assert (numbers(only["in_first"]), numbers(only["in_second"])) == (
        belief_numbers(belief),
        belief_numbers(belief.inverse()),
    )


def test_the_file_is_graphml_and_the_same_every_time(folder: Path) -> None:
    written = [path.read_bytes() for path in export_topology(folder)]
    assert [path.read_bytes() for path in export_topology(folder)] == written
    assert ElementTree.fromstring(written[0]).tag == "{http://graphml.graphdrawing.org/xmlns}graphml"


def test_a_folder_with_the_file_in_it_can_still_be_replaced(folder: Path) -> None:
    export_topology(folder)
    check_replaceable(folder)


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HmtSlamError, match="holds no hmt_map"):
        export_topology(tmp_path)
    assert list(tmp_path.iterdir()) == []
