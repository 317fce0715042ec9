"""The topology as GraphML, read back by networkx and by the standard library."""

from pathlib import Path
from xml.etree import ElementTree

import networkx as nx
import numpy as np
import pytest
from test_output_folder import COVARIANCE, MAP_T_AREA_1, recorded, write

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.local_map.area_kind import AreaKinds
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.offline.output_folder import check_replaceable
from hmt_slam_ros.offline.saved_map import read_saved_map
from hmt_slam_ros.offline.topology_file import export_topology

NUMBERS = ("x", "y", "theta", "xx", "xy", "xt", "yy", "yt", "tt")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("exported")
    write(directory, recorded())
    return directory


def numbers(attributes: dict) -> list[float]:
    return [attributes[name] for name in NUMBERS]


def of(belief) -> list[float]:
    return [*belief.mean.tolist(), *belief.covariance[np.triu_indices(3)].tolist()]


def test_areas_and_arcs_read_back_as_the_map_has_them(folder: Path) -> None:
    graph = nx.read_graphml(export_topology(folder), node_type=int)
    saved = read_saved_map(folder / "hmt_map")
    hybrid_map = saved.replica.maps[saved.replica.best]
    kinds = AreaKinds(LocalMapping(saved.configuration))
    assert graph.is_directed()
    assert sorted(graph) == hybrid_map.area_ids() == [0, 1]
    for area, attributes in graph.nodes.items():
        assert numbers(attributes) == of(saved.area_poses[area])
        assert attributes["keyframes"] == len(hybrid_map.keyframes(area))
        assert attributes["robot"] is (area == 1)
        keyframes = hybrid_map.keyframes(area)
        kind = kinds.of([saved.replica.scans[k] for k in keyframes], np.array(list(keyframes.values())))
        assert attributes.get("hallway") == (None if kind is None else kind.probability)
    arcs = {(a, b): arc for a, b, arc in hybrid_map.all_arcs()}
    assert set(graph.edges) == set(arcs) == {(0, 1)}
    attributes = graph.edges[0, 1]
    assert numbers(attributes) == of(arcs[0, 1].pose)
    assert numbers(attributes)[:3] == pytest.approx(MAP_T_AREA_1)
    assert [attributes[name] for name in ("xx", "yy", "tt")] == pytest.approx(np.diag(COVARIANCE))
    assert attributes["closure"] is True


def test_the_file_is_graphml_and_the_same_every_time(folder: Path) -> None:
    written = export_topology(folder).read_bytes()
    assert export_topology(folder).read_bytes() == written
    assert ElementTree.fromstring(written).tag == "{http://graphml.graphdrawing.org/xmlns}graphml"


def test_a_folder_with_the_file_in_it_can_still_be_replaced(folder: Path) -> None:
    export_topology(folder)
    check_replaceable(folder)


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HmtSlamError, match="holds no hmt_map"):
        export_topology(tmp_path)
    assert list(tmp_path.iterdir()) == []
