"""Runs the five processes on a simulated log, and compares their messages with the truth.

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
from benchmark.simulated.closures import Closure, Paths, answers_by_arcs, live_answers
from benchmark.simulated.examinations import Examination, ObservedBranching, Row, examination_rows
from benchmark.simulated.loops import Loop, Loops, find_rivalries
from benchmark.simulated.records import code_hash
from benchmark.simulated.truth import Pose, Truth, nees, score_openings
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.messages import ClosureDecision, EndOfLog, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.offline.lock_step import LockStep
from hmt_slam_ros.process_table import PROCESSES
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import SimulatedLog, open_simulated
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

Entry = dict[str, Any]

_POSE_PERIOD = 2_000_000_000  # ns between two poses of RTL that are scored


@dataclass(frozen=True)
class _ObservedProcess:
    """A process whose messages are passed to a listener."""

    process: Process
    listener: Callable[[Message], None]

    def handle(self, message: Message) -> list[Message]:
        """Handle a message as the process."""
        messages = self.process.handle(message)
        for answer in messages:
            self.listener(answer)
        return messages


@dataclass
class Watch:
    """Scores a run while it is made.

    :ivar truth: about the keyframes.
    :ivar traveled: {keyframe event: path length since the start, m}.
    :ivar rows: of all comparisons with known areas.
    :ivar events: keyframe events with a fit in a known area.
    :ivar accepted: the closures that became definite.
    :ivar poses: of RTL.
    :ivar pmf: the live hypotheses after every keyframe event.
    :ivar loops: of the drive.
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
        self.traveled: dict[int, float] = {}
        self._samples: dict[int, float] = {}
        self._examinations: dict[int, Examination] = {}
        self._area_poses: dict[int, PoseGaussian] = {}
        self._next_pose = 0
        self._tlca = Tlca(self.configuration)

    def run(self) -> None:
        """Map the whole log."""
        configuration = self.configuration
        processes: dict[str, Process] = {row.name: row.make(configuration) for row in PROCESSES}
        processes |= {"tsbi": Tsbi(configuration, self.branching), "tlca": self._tlca}
        lock_step = LockStep({name: _ObservedProcess(process, self._on_message) for name, process in processes.items()})
        for record in self.log.records():
            lock_step.feed(record.measurement)
        lock_step.feed(EndOfLog())
        self.loops.finish()

    def branching(self, configuration: Configuration, replica: Replica) -> Branching:
        """The branching of TSBI, with a listener."""
        return ObservedBranching(configuration, replica, self._add_examination)

    def _on_message(self, message: Message) -> None:
        match message:
            case Keyframe():
                self._add_keyframe(message)
            case Hypotheses():
                self._add_hypotheses(message)
            case ClosureDecision():
                self._add_decision(message)
            case RealTimePose() if message.stamp >= self._next_pose:
                self._next_pose = message.stamp + _POSE_PERIOD
                self._score_pose(message)

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        self.truth.add_keyframe(keyframe)
        self.traveled[keyframe.sequence] = keyframe.path_length
        self._samples = {estimate.hypothesis: estimate.effective_samples for estimate in keyframe.estimates}
        self._replica.add_keyframe(keyframe)
        best = self._replica.best_hypothesis
        self.loops.add_event(
            keyframe.sequence, keyframe.path_length, self._replica.maps[best], self._replica.robot_areas[best]
        )
        self._examinations = {}

    def _add_examination(self, examination: Examination) -> None:
        self._examinations[examination.parent.hypothesis] = examination
        event = max(self.traveled)
        self.rows += examination_rows(examination, self.truth, self.configuration, event, self.traveled)

    def _add_hypotheses(self, hypotheses: Hypotheses) -> None:
        before = tuple(self._replica.probabilities.items())
        arc_errors = answers_by_arcs(before, self._examinations, self._paths.paths, self.truth)
        self._paths.follow(hypotheses, self._replica, self._examinations)
        self._record_pmf(hypotheses)
        if any(examination.found.fits for examination in self._examinations.values()):
            answers = live_answers(hypotheses, self._replica, self._examinations, self._paths.paths)
            self.events.append(
                {
                    "event": hypotheses.sequence,
                    "traveled": self.traveled[hypotheses.sequence],
                    "unexamined": hypotheses.unexamined,
                    "answers": [asdict(answer) for answer in answers],
                    "arcs_alone": [asdict(answer) | {"among": among} for answer, among in arc_errors],
                }
            )
        self._replica.apply_hypotheses(hypotheses)

    def _record_pmf(self, hypotheses: Hypotheses) -> None:
        """Add the PMF, with the numbers of true and false loops that every hypothesis closes now."""
        entries = []
        for hypothesis in hypotheses.hypotheses:
            closures = self._paths.paths[hypothesis.id].closures
            is_true = [closure.assessment.true for closure in closures if closure.event == hypotheses.sequence]
            entry = {"hypothesis": hypothesis.id, "parent": hypothesis.parent, "probability": hypothesis.probability}
            entries.append(
                entry
                | {"samples": self._samples[hypothesis.parent], "right": sum(is_true), "wrong": is_true.count(False)}
            )
        event = hypotheses.sequence
        position = {"event": event, "stamp": self.truth.stamps[event], "traveled": self.traveled[event]}
        self.pmf.append(position | {"unexamined": hypotheses.unexamined, "hypotheses": entries})

    def _add_decision(self, decision: ClosureDecision) -> None:
        self._replica.apply_decision(decision)
        if decision.global_poses:
            self._area_poses = {area.area: area.pose for area in decision.global_poses}
        if decision.hypothesis is None:
            return
        probability, chosen = self._tlca.supports[decision.hypothesis], self._replica.maps[decision.hypothesis]
        for closure in self._paths.take_accepted(decision.hypothesis, chosen):
            self.accepted.append(self._closure_entry(closure, decision.sequence, probability))
        self.loops.update_definite(decision.sequence, chosen, self._replica.robot_areas[decision.hypothesis])

    def best_map(self) -> tuple[HybridMap, Mapping[int, Scan]]:
        """The most probable map, and the scans of its keyframes."""
        return self._replica.maps[self._replica.best_hypothesis], self._replica.scans

    def pending_closures(self) -> list[Entry]:
        """The closures of the most probable path that are not definite."""
        best = self._replica.best_hypothesis
        event, probability = max(self.traveled), self._replica.probabilities[best]
        return [self._closure_entry(closure, event, probability) for closure in self._paths.paths[best].closures]

    def _closure_entry(self, closure: Closure, event: int, probability: float) -> Entry:
        return {
            "event": event,
            "asked_at": closure.event,
            "way": closure.way,
            "areas": closure.areas,
            "waited": self.traveled[event] - self.traveled[closure.event],
            "probability": probability,
            "right": closure.assessment.true,
            **closure.assessment._asdict(),
        }

    def _score_pose(self, pose: RealTimePose) -> None:
        """Add the errors of the pose in the map and in the robot's area."""
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
                "map": _pose_error(pose.map_pose, in_map),
                "local": _pose_error(pose.pose_in_area, in_area),
            }
        )

    def arc_errors(self) -> list[Entry]:
        """Errors of the arcs of the current most probable map."""
        best = self._replica.maps[self._replica.best_hypothesis]
        frames = {area: self.truth.frame(best, area) for area in best.area_ids()}
        return [
            {"areas": (a, b), "closure": arc.closure, **_pose_error(arc.pose, se2.between(frames[a], frames[b]))}
            for a, b, arc in best.all_arcs()
        ]

    def area_pose_errors(self) -> list[Entry]:
        """Errors of the areas' poses of the last closure decision."""
        best = self._replica.maps[self._replica.best_hypothesis]
        origin = self.truth.frame(best, FIRST_AREA)
        return [
            {"area": area, **_pose_error(pose, se2.between(origin, self.truth.frame(best, area)))}
            for area, pose in self._area_poses.items()
            if area != FIRST_AREA and area in best.area_ids()
        ]


def _pose_error(belief: PoseGaussian, truth: Pose) -> Entry:
    """Translation (m) and rotation (degrees) of an error, its NEES and the stated deviation (m)."""
    error = se2.between(belief.mean, truth)
    return {
        "translation": float(np.hypot(error[0], error[1])),
        "rotation": float(np.degrees(abs(error[2]))),
        "nees": nees(belief, truth),
        "sigma": float(np.sqrt(np.trace(belief.covariance[:2, :2]))),
    }


def observe_world(world: World, changes: Sequence[str] = ()) -> dict[str, Any]:
    """Run a world; return its record."""
    begin = time.process_time()
    watch = Watch(open_simulated(world.log), load_configuration(PARAMETERS, list(changes), world.seed))
    watch.run()
    return {
        "world": world.log,
        "family": world.family,
        "seed": world.seed,
        "changes": list(changes),
        "code": code_hash(),
        "keyframes": len(watch.truth.poses),
        "columns": Row._fields,
        "rows": watch.rows,
        "events": watch.events,
        "accepted": watch.accepted,
        "pending": watch.pending_closures(),
        "loops": [_loop_entry(loop) for loop in watch.loops.found],
        "arcs": watch.arc_errors(),
        "area_poses": watch.area_pose_errors(),
        "poses": watch.poses,
        "pmf": watch.pmf,
        "rivalries": [
            vars(found) for found in find_rivalries(watch.log, watch.truth, watch.loops.found, watch.traveled)
        ],
        "doors": score_openings(watch.truth, *watch.best_map(), watch.configuration),
        "cpu_s": time.process_time() - begin,
    }


def _loop_entry(loop: Loop) -> dict[str, Any]:
    return {
        **{name: value for name, value in vars(loop).items() if name != "partners"},
        "can_be_closed": loop.can_be_closed,
        "in_time": loop.in_time,
    }


def _make_json_safe(value: Any) -> Any:  # noqa: ANN401  any content of a record
    """The same value for JSON, with seven digits."""
    if isinstance(value, dict):
        return {name: _make_json_safe(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_make_json_safe(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def main(arguments: Sequence[str]) -> int:
    """Run; return the exit status."""
    family, seed, file, *changes = arguments
    try:
        record = observe_world(World(family, int(seed)), changes)
    except HmtSlamError as fault:
        print(f"watch: {fault}", file=sys.stderr)
        return 2
    # The file is renamed when it is complete, so that an interrupted run leaves no record.
    part = Path(f"{file}.part")
    with gzip.open(part, "wt", encoding="utf-8") as target:
        json.dump(_make_json_safe(record), target, allow_nan=False)
    part.replace(file)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
