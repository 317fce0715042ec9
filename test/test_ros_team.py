"""Robots of a team as nodes over DDS: they share maps, find one another, and tie their map frames."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from benchmark.recorded_chain import ChainPublisher, record_chain
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.documents import decode, encode
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import (
    NO_REPETITION,
    SharedArea,
    TeamPlacement,
    TeamRequest,
    TeamStatus,
    TeamUpdate,
    Verdict,
)
from hmt_slam_ros.registration.consistency import NO_CLUTTER, Clutter
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS

OFFICE, OTHER = "sim:office,size=0.7,seed=51", "sim:office,size=0.7,seed=50"
SEED = {"seed": 50}


@cache
def chain(world, lap):
    """The messages of the chain of a robot that drives one of two laps."""
    return record_chain(Configuration(**SEED), world, lap)


class Robot:
    """The node ``team`` of a robot, and the publishers of the rest of its chain."""

    def __init__(self, name, start, listener, **parameters):
        self.name, self.listener, self._start, self._parameters = name, listener, start, parameters
        self._chain = ChainPublisher(listener.node, name)
        self.transforms = listener.subscribe(TFMessage, f"/{name}/tf", topics.STREAM)
        self._reports = listener.subscribe(DiagnosticArray, f"/{name}/{DIAGNOSTICS}", topics.STREAM)
        self.start()

    def start(self):
        arguments = ("-r", f"__ns:=/{self.name}")
        self.process = self._start("team", *arguments, **SEED, system=self.name, **self._parameters)

    def play(self, messages):
        for message in messages:
            self._chain.publish(message)

    @property
    def values(self):
        """What its newest diagnostics show."""
        statuses = [status for report in self._reports for status in report.status]
        return {entry.key: entry.value for entry in statuses[-1].values} if statuses else {}

    def knows(self, other, team):
        """Whether it has the whole map that another one shares."""
        newest = max(status.map_version for status in team.messages(TeamStatus) if status.robot == other.name)
        return self is other or self.values.get(f"map of {other.name}", "").startswith(
            f"version {newest} of {newest}, "
        )

    @property
    def map_pose(self):
        """The newest ``team_T_map``, shape (3,), None without."""
        if not self.transforms:
            return None
        (transform,) = self.transforms[-1].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("team", "map")
        shift, turn = transform.transform.translation, transform.transform.rotation
        return np.array([shift.x, shift.y, 2.0 * np.arctan2(turn.z, turn.w)])


@pytest.fixture
def team(listener, start):
    """Starts robots, and has what they send one another."""

    class Team:
        def __init__(self):
            self.robots = []
            self.sent = {
                kind: listener.subscribe(
                    String, DOCUMENTS[kind], topics.TEAM_HISTORY if kind is TeamPlacement else topics.STREAM
                )
                for kind in (TeamStatus, TeamRequest, TeamUpdate, TeamPlacement)
            }

        def add(self, name, **parameters):
            self.robots.append(Robot(name, start, listener, **parameters))
            return self.robots[-1]

        def until(self, condition):
            listener.until(condition, alive=[robot.process for robot in self.robots])

        def messages(self, kind):
            return [decode(message.data, kind) for message in self.sent[kind]]

        def shared_scans(self, robot):
            """The keyframes that a robot has shared."""
            updates = [each for each in self.messages(TeamUpdate) if each.robot == robot.name]
            return {item.keyframe for update in updates for item in update.scans}

        def answers(self):
            """{(robot, first, second): the last answer}."""
            return {(each.robot, each.first, each.second): each for each in self.messages(TeamPlacement)}

        def answer(self, robot, other):
            return self.answers().get((robot.name, *sorted((robot.name, other.name))))

        def verdict(self, robot, other):
            answer = self.answer(robot, other)
            return answer and answer.verdict

        def is_sure(self, robot, other):
            answer = self.answer(robot, other)
            return answer is not None and answer.probability > 0.99

    return Team()


def mapped_scans(messages):
    """The keyframes in the map of a chain."""
    replica = Replica()
    for message in messages:
        replica.apply_message(message)
    return replica.scans.keys()


def is_near(pose, expected):
    return pose is not None and np.abs(se2.between(expected, pose)).max() < 1e-6


def test_robots_of_one_building_find_one_another_and_a_third_stays_apart(team, tmp_path):
    """One of them is killed then, and goes on with its map and those of the others."""
    ann, bob, cid = (team.add(name, recovery=tmp_path) for name in ("ann", "bob", "cid"))
    cid.play(chain(OTHER, 1))
    chains = {ann: chain(OFFICE, 0), bob: chain(OFFICE, 1)}
    for robot, messages in chains.items():
        robot.play(messages[: 3 * len(messages) // 4])
    team.until(lambda: team.is_sure(ann, bob) and team.is_sure(bob, ann))
    for robot, messages in chains.items():
        robot.play(messages[3 * len(messages) // 4 :])
    team.until(lambda: team.verdict(ann, bob) == team.verdict(bob, ann) == Verdict.JOINED)
    # The frame of the team is the map of the first robot, by whose answers both go.
    team.until(lambda: is_near(ann.map_pose, np.zeros(3)))
    team.until(lambda: is_near(bob.map_pose, team.answers()["ann", "ann", "bob"].pose))
    team.until(lambda: team.verdict(cid, ann) is not None and team.verdict(cid, bob) is not None)
    assert {each.verdict for key, each in team.answers().items() if "cid" in key} <= {Verdict.APART, Verdict.OPEN}
    assert not cid.transforms
    team.until(lambda: ann.values["joined with"] == "bob" and cid.values["joined with"] == "none")
    # They stand now, so that all of the areas is shared in which they are.
    for robot, messages in chains.items():
        team.until(lambda robot=robot, messages=messages: team.shared_scans(robot) >= mapped_scans(messages))
    # What a robot shares is sent once, though two others want it; again only to one that requested it again, as lost.
    requests = Counter((each.robot, each.owner, each.after) for each in team.messages(TeamRequest))
    repeated = {(owner, after): count for (_, owner, after), count in requests.items() if count > 1}
    for robot in team.robots:
        sent = [each for each in team.messages(TeamUpdate) if each.robot == robot.name]
        once = [each for each in sent if (each.robot, each.after) not in repeated]
        items = [(item.version, type(item)) for update in once for item in update.items]
        assert len(items) == len(set(items))
        for after, count in Counter(each.after for each in sent).items():
            assert count <= repeated.get((robot.name, after), 1)

    team.until(lambda: all(robot.knows(other, team) for robot in team.robots for other in team.robots))
    sent = len(team.messages(TeamUpdate))
    session = {status.session for status in team.messages(TeamStatus) if status.robot == "bob"}
    bob.process.kill()
    bob.process.communicate()
    transforms = len(bob.transforms)
    bob.start()
    team.until(lambda: len(bob.transforms) > transforms and bob.values.get("joined with") == "ann")
    assert {status.session for status in team.messages(TeamStatus) if status.robot == "bob"} == session
    assert len(team.messages(TeamUpdate)) == sent
    assert team.verdict(bob, ann) is Verdict.JOINED


def test_what_is_no_message_of_a_team_is_refused_by_name(team, listener):
    bob = team.add("bob")
    team.until(lambda: team.messages(TeamStatus))
    publishers = {
        kind: listener.node.create_publisher(String, DOCUMENTS[kind], topics.TEAM_HISTORY) for kind in team.sent
    }
    empty = TeamUpdate("ann", "1", 0, 1, (), (), True, NO_CLUTTER)
    area = SharedArea(1, 0, (0, 0), (np.zeros(3), np.zeros(3)), ())
    strange = {
        TeamStatus: [
            encode(TeamStatus("bob", "another", 1, "0", NO_REPETITION)),
            "{}",
            encode(TeamStatus("", "1", 1, "0", NO_REPETITION)),
        ],
        TeamRequest: [encode(TeamRequest("ann", "bob", "1", 0)).replace('"version":1', '"version":7')],
        TeamUpdate: [
            encode(replace(empty, clutter=Clutter(1.5, 0.0))),
            encode(replace(empty, areas=(area,))),
            encode(replace(empty, areas=(replace(area, version=9),))),
        ],
        TeamPlacement: [encode(TeamPlacement("ann", "bob", "ann", Verdict.JOINED, 1.0, 0.0, np.zeros(3)))],
    }
    for kind, documents in strange.items():
        listener.until(lambda kind=kind: publishers[kind].get_subscription_count() == 2)
        for document in documents:
            publishers[kind].publish(String(data=document))
    refused = {f"refused on {DOCUMENTS[kind]}": str(len(documents)) for kind, documents in strange.items()}
    team.until(lambda: refused.items() <= bob.values.items())
    assert bob.values["joined with"] == "none"
