"""The places of a map in places.json."""

import json
from pathlib import Path

import numpy as np
import pytest
from small_floor import AREAS, make_chart

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.results.export import write_places

BACK = {"north": "south", "south": "north", "east": "west", "west": "east"}


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict:
    chart, _, _ = make_chart()
    poses = {area: PoseGaussian.from_pose(pose) for area, pose in AREAS.items()}
    path: Path = write_places(tmp_path_factory.mktemp("places"), poses, chart)
    assert path.name == "places.json"
    return json.loads(path.read_text())


def test_places_stand_where_their_areas_are(document: dict) -> None:
    assert sorted(place["kind"] for place in document["places"]) == ["crossing", "door", "door", "end", "end", "end"]
    for place in document["places"]:
        pose = se2.compose(AREAS[place["area"]], np.array(place["area_T_place"]))
        assert place["map_T_place"] == pytest.approx(pose.tolist())
        assert bool(place["openings"]) == (place["kind"] != "end")
        assert 0.5 <= place["existence"] <= 1.0
    openings = [opening for place in document["places"] for opening in place["openings"]]
    assert [opening["width"] for opening in openings if not opening["hallway"]] == pytest.approx([1.0] * 3, abs=0.05)


def test_ways_lead_from_place_to_place_and_back(document: dict) -> None:
    places, ways = document["places"], document["ways"]
    both = {(way["start"], way["end"], way["direction"]) for way in ways}
    assert both == {(end, start, BACK[direction]) for start, end, direction in both}
    for way in ways:
        start, end = (places[way[name]]["map_T_place"] for name in ("start", "end"))
        assert way["distance"] == pytest.approx(float(np.hypot(end[0] - start[0], end[1] - start[1])), abs=0.3)
        assert way["deviation"] > 0.0


def test_landmarks_stand_in_the_order_in_which_they_are_met(document: dict) -> None:
    every = [landmark for way in document["ways"] for landmark in way["landmarks"]]
    assert {landmark["track"] for landmark in every} >= {"left convex corner", "right convex corner"}
    for way in document["ways"]:
        along = [landmark["along"] for landmark in way["landmarks"]]
        assert along == sorted(along)
