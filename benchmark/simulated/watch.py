"""Watches the five processes on a simulated log: what they say, and what is true of it.

``python -m benchmark.simulated.watch FAMILY SEED FILE [NAME=VALUE ...]`` maps a simulated log. FILE becomes a JSON
document, gzipped.
"""

from __future__ import annotations

import gzip
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.runs import PARAMETERS
from benchmark.simulated.closures import Closure, Paths, answers, by_arcs_alone
from benchmark.simulated.examinations import Examination, Row, WatchedBranching, rows
from benchmark.simulated.loops import Loop, Loops, rivalries
from benchmark.simulated.records import code
from benchmark.simulated.truth import Pose, Truth, doors, nees
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import ClosureDecision, EndOfLog, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.offline.runtime import LockStep
from hmt_slam_ros.process_table import PROCESSES
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import SimulatedLog, open_simulated
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

Entry = dict[str, Any]

_POSE_PERIOD = 2_000_000_000  # ns between two poses of RTL that are judged


@dataclass(frozen=True)
class _Tapped:
    """A process of which somebody hears all that it says."""

    process: Process
    heard: Callable[[Message], None]

    def handle(self, message: Message) -> list[Message]:
        """As the process does."""
        said = self.process.handle(message)
        for word in said:
            self.heard(word)
        return said


@dataclass
class Watch:
    """Judges a run while it goes on.

    :ivar truth: about the keyframes.
    :ivar travelled: {keyframe event: path length since the start, m}.
    :ivar rows: of all comparisons with known areas.
    :ivar events: keyframe events at which there was a known area that the keyframes fit into.
    :ivar accepted: the closures that became definite.
    :ivar poses: of RTL.
    :ivar pmf: the live hypotheses after every keyframe event.
    :ivar loops: that there are to close.
    """

    log: SimulatedLog
    configuration: Configuration
    rows: list[Row] = field(default_factory=list)
    events: list[Entry] = field(default_factory=list)
    accepted: list[Entry] = field(default_factory=list)
    poses: list[Entry] = field(default_factory=list)
    pmf: list[Entry] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.truth = Truth(self.log)
        self.loops = Loops(self.truth)
        self._replica = Replica()
        self._paths = Paths(self.truth)
        self.travelled: dict[int, float] = {}
        self._samples: dict[int, float] = {}
        self._asked: dict[int, Examination] = {}
        self._area_poses: dict[int, PoseGaussian] = {}
        self._next_pose = 0

    def run(self) -> None:
        """Map the whole log."""
        configuration = self.configuration
        processes: dict[str, Process] = {row.name: row.make(configuration) for row in PROCESSES}
        processes["tsbi"] = Tsbi(configuration, self.branching)
        lock_step = LockStep({name: _Tapped(process, self._hear) for name, process in processes.items()})
        for record in self.log.records():
            lock_step.feed(record.measurement)
        lock_step.feed(EndOfLog())
        self.loops.finish()

    def branching(self, configuration: Configuration, replica: Replica) -> Branching:
        """What makes the children of hypotheses, watched."""
        return WatchedBranching(configuration, replica, self._examined)

    def _hear(self, message: Message) -> None:
        match message:
            case Keyframe():
                self._note(message)
            case Hypotheses():
                self._follow(message)
            case ClosureDecision():
                self._accept(message)
            case RealTimePose() if message.stamp >= self._next_pose:
                self._next_pose = message.stamp + _POSE_PERIOD
                self._judge_pose(message)

    def _note(self, keyframe: Keyframe) -> None:
        self.truth.note(keyframe)
        self.travelled[keyframe.sequence] = keyframe.path_length
        self._samples = {leaf.hypothesis: leaf.effective_samples for leaf in keyframe.estimates}
        self._replica.add_keyframe(keyframe)
        best = self._replica.best_hypothesis
        self.loops.note(
            keyframe.sequence, keyframe.path_length, self._replica.maps[best], self._replica.robot_areas[best]
        )
        self._asked = {}

    def _examined(self, examination: Examination) -> None:
        self._asked[examination.parent.hypothesis] = examination
        event = max(self.travelled)
        self.rows += rows(examination, self.truth, self.configuration, event, self.travelled)

    def _follow(self, hypotheses: Hypotheses) -> None:
        before = tuple(self._replica.probabilities.items())
        arcs = by_arcs_alone(before, self._asked, self._paths.paths, self.truth)
        self._paths.follow(hypotheses, self._replica, self._asked)
        self._tell(hypotheses)
        if any(examination.found.fits for examination in self._asked.values()):
            given = answers(hypotheses, self._replica, self._asked, self._paths.paths)
            self.events.append(
                {
                    "event": hypotheses.sequence,
                    "travelled": self.travelled[hypotheses.sequence],
                    "unexamined": hypotheses.unexamined,
                    "answers": [asdict(answer) for answer in given],
                    "arcs_alone": [asdict(answer) | {"among": among} for answer, among in arcs],
                }
            )
        self._replica.apply_hypotheses(hypotheses)

    def _tell(self, hypotheses: Hypotheses) -> None:
        """Keep the PMF, and the loops that every hypothesis closes now: those that there are, and those that not."""
        leaves = []
        for leaf in hypotheses.hypotheses:
            closures = self._paths.paths[leaf.id].closures
            now = [closure.claim.true for closure in closures if closure.event == hypotheses.sequence]
            told = {"hypothesis": leaf.id, "parent": leaf.parent, "probability": leaf.probability}
            leaves.append(told | {"samples": self._samples[leaf.parent], "right": sum(now), "wrong": now.count(False)})
        event = hypotheses.sequence
        where = {"event": event, "stamp": self.truth.stamps[event], "travelled": self.travelled[event]}
        self.pmf.append(where | {"unexamined": hypotheses.unexamined, "leaves": leaves})

    def _accept(self, accepted: ClosureDecision) -> None:
        probabilities = dict(self._replica.probabilities)
        self._replica.apply_decision(accepted)
        if accepted.global_poses:
            self._area_poses = {area.area: area.pose for area in accepted.global_poses}
        if accepted.hypothesis is None:
            return
        chosen = self._replica.maps[accepted.hypothesis]
        for closure in self._paths.accepted(accepted.hypothesis, chosen):
            self.accepted.append(self._entry(closure, accepted.sequence, probabilities[accepted.hypothesis]))
        self.loops.definite(accepted.sequence, chosen, self._replica.robot_areas[accepted.hypothesis])

    def mapped(self) -> tuple[HybridMap, Mapping[int, Scan]]:
        """The most probable map, and the scans of its keyframes."""
        return self._replica.maps[self._replica.best_hypothesis], self._replica.scans

    def pending(self) -> list[Entry]:
        """The closures of the most probable path that are not definite."""
        best = self._replica.best_hypothesis
        event, probability = max(self.travelled), self._replica.probabilities[best]
        return [self._entry(closure, event, probability) for closure in self._paths.paths[best].closures]

    def _entry(self, closure: Closure, event: int, probability: float) -> Entry:
        return {
            "event": event,
            "asked_at": closure.event,
            "way": closure.way,
            "areas": closure.areas,
            "waited": self.travelled[event] - self.travelled[closure.event],
            "probability": probability,
            "right": closure.claim.true,
            **closure.claim._asdict(),
        }

    def _judge_pose(self, pose: RealTimePose) -> None:
        """Errors of the pose in the map and of that in the robot's area."""
        best = self._replica.maps[self._replica.best_hypothesis]
        if pose.area not in best.area_ids():
            return
        truth = self.log.true_poses(np.array([pose.stamp]))[0]
        in_map = se2.between(self.truth.frame(best, FIRST_AREA), truth)
        in_area = se2.between(self.truth.frame(best, pose.area), truth)
        self.poses.append(
            {
                "stamp": pose.stamp,
                "area": pose.area,
                "map": _error(pose.map_pose, in_map),
                "local": _error(pose.pose_in_area, in_area),
            }
        )

    def arcs(self) -> list[Entry]:
        """Errors of the arcs of the most probable map as it is now."""
        best = self._replica.maps[self._replica.best_hypothesis]
        frames = {area: self.truth.frame(best, area) for area in best.area_ids()}
        return [
            {"areas": (a, b), "closure": arc.closure, **_error(arc.pose, se2.between(frames[a], frames[b]))}
            for a, b, arc in best.all_arcs()
        ]

    def area_poses(self) -> list[Entry]:
        """Errors of the areas' poses in the map as TLCA last gave them."""
        best = self._replica.maps[self._replica.best_hypothesis]
        origin = self.truth.frame(best, FIRST_AREA)
        return [
            {"area": area, **_error(pose, se2.between(origin, self.truth.frame(best, area)))}
            for area, pose in self._area_poses.items()
            if area != FIRST_AREA and area in best.area_ids()
        ]


def _error(belief: PoseGaussian, truth: Pose) -> Entry:
    """Translation (m) and rotation (degrees) of an error, its NEES and the deviation that is stated (m)."""
    error = se2.between(belief.mean, truth)
    return {
        "translation": float(np.hypot(error[0], error[1])),
        "rotation": float(np.degrees(abs(error[2]))),
        "nees": nees(belief, truth),
        "sigma": float(np.sqrt(np.trace(belief.covariance[:2, :2]))),
    }


def watched(world: World, changes: Sequence[str] = ()) -> dict[str, Any]:
    """All that is kept of a run."""
    begin = time.process_time()
    watch = Watch(open_simulated(world.log), load_configuration(PARAMETERS, list(changes), world.seed))
    watch.run()
    return {
        "world": world.log,
        "family": world.family,
        "seed": world.seed,
        "changes": list(changes),
        "code": code(),
        "keyframes": len(watch.truth.poses),
        "columns": Row._fields,
        "rows": watch.rows,
        "events": watch.events,
        "accepted": watch.accepted,
        "pending": watch.pending(),
        "loops": [_loop(loop) for loop in watch.loops.found],
        "arcs": watch.arcs(),
        "area_poses": watch.area_poses(),
        "poses": watch.poses,
        "pmf": watch.pmf,
        "rivalries": [vars(found) for found in rivalries(watch.log, watch.truth, watch.loops.found, watch.travelled)],
        "doors": doors(watch.truth, *watch.mapped(), watch.configuration),
        "cpu_s": time.process_time() - begin,
    }


def _loop(loop: Loop) -> dict[str, Any]:
    return {
        **{name: value for name, value in vars(loop).items() if name != "partners"},
        "can_be_closed": loop.can_be_closed,
        "in_time": loop.in_time,
    }


def _plain(value: Any) -> Any:  # noqa: ANN401  whatever is in a record
    """The same in what JSON knows, figures to seven digits."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def main(arguments: Sequence[str]) -> int:
    """Run; return the exit status."""
    family, seed, file, *changes = arguments
    try:
        record = watched(World(family, int(seed)), changes)
    except HmtSlamError as fault:
        print(f"watch: {fault}", file=sys.stderr)
        return 2
    # Under another name first, so that an interrupted run leaves nothing that looks like a record.
    part = Path(f"{file}.part")
    with gzip.open(part, "wt", encoding="utf-8") as target:
        json.dump(_plain(record), target, allow_nan=False)
    part.replace(file)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
