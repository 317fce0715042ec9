"""Where areas end: at the openings that the robot passes, at cuts of which openings are a part, or at cuts."""

import numpy as np
import pytest
import worlds
from test_area_abstraction_aam import OPTIONS, WORLD, drive_until_cut, estimate, exact, keyframe, stay

from hmt_slam_ros.area_abstraction.aam import Aam
from hmt_slam_ros.area_abstraction.partition import AamState
from hmt_slam_ros.composition import area_abstraction
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, Keyframe
from hmt_slam_ros.saved_map.folder import FolderReader, FolderWriter

# Straight on through the door, in the first room and behind it.
THROUGH = worlds.drive((1.2, 3.0), (10.5, 3.0))
DOOR = 6.0


def by_policy(policy, **changes):
    return area_abstraction(configure(policy, **changes))


def configure(policy, **changes):
    own = {"area_policy": policy, "ncut_threshold": 0.0, "min_cluster": 3, "confirmations": 2} | changes
    return with_changes(Configuration(), OPTIONS | {f"aam.{name}": value for name, value in own.items()})


def looking_ahead(process, poses=THROUGH, first=0):
    """The event of the first cut, where the laser sees half a circle; and its keyframe."""
    for k, pose in enumerate(poses[first:], start=first):
        hypothesis = estimate(0, 0, se2.between(poses[0], pose))
        (answer,) = process.handle(Keyframe(k, worlds.scan_in(WORLD, pose, beams=361), 0.5 * k, (hypothesis,)))
        if answer.events:
            return answer.events[0], k
        process.handle(stay(k, 0))
    return None


def all_around(process, poses=THROUGH):
    try:
        return drive_until_cut(process, poses)
    except pytest.fail.Exception:
        return None


def test_by_both_the_door_makes_a_cut_of_what_is_none():
    assert drive_until_cut(by_policy("both", ncut_threshold=0.5), THROUGH)[0].keyframes[0] == 10
    assert all_around(by_policy("ncut", ncut_threshold=0.5)) is None
    assert all_around(by_policy("both", ncut_threshold=0.5, portal_factor=1.0)) is None


@pytest.mark.parametrize("stop", [3, 9, 12])
def test_what_openings_were_seen_and_passed_is_part_of_the_state(stop, tmp_path):
    options = {"ncut_threshold": 0.5}
    (event, k), process = looking_ahead(by_policy("both", **options)), by_policy("both", **options)
    assert looking_ahead(process, THROUGH[:stop]) is None
    writer = FolderWriter(tmp_path)
    writer.write("aam", process.state)
    writer.finish("state", 1)
    state = FolderReader(tmp_path, "state", 1).read("aam", AamState)
    again = area_abstraction(configure("both", **options), state)
    found, at = looking_ahead(again, THROUGH, stop)
    assert (found.keyframes, found.score, at) == (event.keyframes, event.score, k)


def test_a_state_of_another_policy_goes_on_by_the_own_one():
    process = by_policy("ncut")
    assert looking_ahead(process, THROUGH[:8]) is None
    event, _ = looking_ahead(area_abstraction(configure("both", ncut_threshold=0.5), process.state), THROUGH, 8)
    assert event.keyframes[0] == 10


@pytest.mark.parametrize(("policy", "merged"), [("ncut", True), ("both", False)])
def test_areas_with_an_opening_between_them_are_not_one(policy, merged):
    """Played: a closure joins the two rooms, and by a radius of overlap of meters nothing separates them."""
    process = by_policy("both", ncut_threshold=0.5, portal_factor=0.01)
    event, k = drive_until_cut(process, THROUGH)
    poses = {i: se2.between(THROUGH[0], THROUGH[i]) for i in event.keyframes}
    begun = tuple(MovedKeyframe(i, 0, 1, pose) for i, pose in poses.items())
    arc = Arc(0, 1, exact(np.zeros(3)), closure=True)
    process.handle(Hypotheses(k, (Hypothesis(0, 0, 1.0, 1, exact(np.zeros(3)), begun, (arc,)),)))
    process.handle(ClosureDecision(k, 0, (arc,)))
    changed = {"ncut_threshold": 0.3, "overlap_radius": 2.0, "min_cluster": 5, "portal_factor": 0.01}
    process = area_abstraction(configure(policy, **changed), process.state)
    hypothesis = estimate(0, 1, poses[k], stored=False)
    (answer,) = process.handle(keyframe(k + 1, THROUGH[k], hypothesis))
    assert [event.kind for event in answer.events] == ["merged"] * merged


def test_a_partition_by_doors_without_landmarks_is_refused():
    with pytest.raises(HmtSlamError, match="area_policy = both needs landmarks"):
        Aam(configure("both"))
