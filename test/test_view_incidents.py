"""What happened to the nodes, as the live page keeps it."""

from hmt_slam_ros.view.health import SystemHealth
from hmt_slam_ros.view.incidents import IncidentLog


class Run:
    """Diagnostics of the node slam, once a second."""

    def __init__(self):
        self.health, self.log, self.now = SystemHealth(("slam",)), IncidentLog(), 0.0

    def hear(self, level=0, message="running", seconds=1.0, started="2026-11-29T07:00:00.000+00:00"):
        self.now += seconds
        self.health.update("slam", level, message, {"started at": started}, self.now)
        return self.update()

    def update(self, seconds=0.0):
        self.now += seconds
        found = self.log.update(self.health.nodes, self.now, 1000.0 + self.now)
        return [(incident.level, incident.text) for incident in found]


def test_a_node_that_is_well_leaves_no_trace():
    run = Run()
    assert [run.hear() for _ in range(3)] == [[], [], []]
    assert run.log.rows() == []


def test_a_warning_is_kept_once_with_its_time():
    run = Run()
    run.hear()
    assert run.hear(1, "the wheels slip") == [("attention", "the wheels slip")]
    assert run.hear(1, "the wheels slip") == []
    assert run.hear(2, "the chain has a gap") == [("fault", "the chain has a gap")]
    assert run.log.rows()[-1] == {"time": 1002.0, "node": "slam", "level": "attention", "text": "the wheels slip"}
    assert [row["text"] for row in run.log.rows()] == ["the chain has a gap", "the wheels slip"]


def test_a_node_that_was_killed_and_started_again_leaves_a_trace():
    run = Run()
    run.hear(1, "the wheels slip")
    later = "2026-11-29T07:00:03.000+00:00"
    assert run.hear(started=later, seconds=3.0) == [("attention", "was started again")]
    assert run.hear(1, "the wheels slip", started=later) == [("attention", "the wheels slip")]
    # A second node of this name, which started before.
    assert run.hear(1, "the wheels slip") == []
    assert run.hear(1, "the wheels slip", started=later) == []


def test_a_silence_has_a_begin_and_an_end():
    run = Run()
    run.hear()
    assert run.update(seconds=11.0) == [("fault", "is silent")]
    assert run.update(seconds=11.0) == []
    assert run.hear() == [("good", "is there again")]


def test_the_newest_incidents_are_kept():
    run = Run()
    for number in range(300):
        run.hear(1, f"warning {number}")
    assert len(run.log.rows()) == 100
    assert run.log.rows()[0]["text"] == "warning 299"
