"""A TSBI that closes a loop falsely once, in lock-step with the rest, the documents through JSON as between nodes."""

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.messages.documents import decode, encode
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import ClosureDecision, EndOfLog, Hypotheses
from hmt_slam_ros.offline.lock_step import LockStep
from hmt_slam_ros.process_table import PROCESSES
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.branches import Branches, Child
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

SIGMA = np.diag([0.05, 0.05, np.radians(0.5)]) ** 2


def make_misled(area, known, deviations):
    """What makes the children of hypotheses, once falsely: from ``area`` a loop is closed to ``known``.

    :param deviations: error of the place in deviations of the arcs' belief, in its worst direction.
    """

    class Misled(Branching):
        done = False

        def recheck(self, parent, only=()):
            if self.done or parent.area != area:
                return super().recheck(parent, only)
            Misled.done = True
            belief = shortest_path_beliefs(parent.hybrid_map, area, targets=(known,))[known]
            values, vectors = np.linalg.eigh(belief.covariance)
            wrong = se2.compose(belief.mean, se2.exp(deviations * np.sqrt(values[-1]) * vectors[:, -1]))
            arc = Arc(area, known, PoseGaussian(wrong, SIGMA), closure=True)
            state = parent.state.after_matching((), ())
            return Branches(
                [Child(parent.hypothesis, parent.log_weight, area, state, arcs=(arc,), reload_local_map=True)]
            )

    return Misled


class OverJson:
    """A process whose documents go through JSON, as they do between the nodes."""

    def __init__(self, process):
        self.process = process

    def handle(self, message):
        kind = type(message)
        return self.process.handle(decode(encode(message), kind) if kind in (Hypotheses, ClosureDecision) else message)


def run(log, configuration, branching=Branching):
    """A whole log in lock-step; what was recorded."""
    recorder = Recorder(configuration)
    processes = {row.name: row.make(configuration) for row in PROCESSES}
    processes["tsbi"] = Tsbi(configuration, branching)
    lock_step = LockStep({name: OverJson(process) for name, process in processes.items()} | {"recorder": recorder})
    stamps = []
    for record in log.records():
        lock_step.feed(record.measurement)
        if isinstance(record.measurement, Scan):
            stamps.append(record.measurement.stamp)
    lock_step.feed(EndOfLog())
    replicas = [process._replica for name, process in processes.items() if name != "rtl"]
    return recorder.finish(np.array(stamps)), replicas
