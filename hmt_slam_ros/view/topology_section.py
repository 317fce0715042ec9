"""Sections of the live page from documents: the map, the maps of other hypotheses, and what speaks for each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import ELLIPSE_95, PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.alternatives import Alternative, Alternatives
from hmt_slam_ros.messages.evidence import BranchStep, Evidence
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.topology import Topology, TopologyArc, TopologyArea
from hmt_slam_ros.sensors.plausibility import MAX_STAMP
from hmt_slam_ros.untrusted_input import shorten

_MAX_ARCS = 20_000
"""Arcs of a map that is shown."""

_MAX_KEYFRAMES = 50_000
"""Keyframes of a map that is shown."""

_MAX_STATEMENTS = 20
"""Statements of people that are shown, the newest."""

_MAX_STATEMENT = 300
"""Characters of a statement."""

_UNKNOWN_PLACE = "It is not known where this is in the map."

_TITLES = {
    "closure": "closes {area} with {other}",
    "known_area": "is back in area {area}",
    "new_area": "is on new ground, area {area}",
    "unchanged": "stays in area {area}, closes nothing",
    "lost": "may be anywhere: it was moved, or an arc is wrong",
    "withdrawal": "withdraws the closure of {area} with {other}",
}
"""{kind of a step: what the robot does under the hypothesis}."""


def topology_section(topology: Topology) -> dict[str, Any]:
    """Areas with their keyframes, arcs and live hypotheses; poses in m and rad.

    :raises HmtSlamError: where it is too large to be shown.
    """
    keyframes = sum(len(area.keyframes) for area in topology.areas)
    if len(topology.arcs) > _MAX_ARCS or keyframes > _MAX_KEYFRAMES:
        raise HmtSlamError(
            f"a map of {len(topology.arcs)} arcs and {keyframes} keyframes is too large to be shown: look who "
            "publishes it"
        )
    if topology.stamp > MAX_STAMP:
        raise HmtSlamError(f"stamp = {shorten(topology.stamp)} is none of a keyframe: look who publishes it")
    poses = {area.area: area.pose for area in topology.areas}
    return {
        "events": topology.events,
        "time": round(topology.stamp / NANOSECONDS, 3),
        "best": topology.hypotheses[0].hypothesis if topology.hypotheses else None,
        "hypotheses": [[h.hypothesis, round(h.probability, 5), h.area] for h in topology.hypotheses],
        "area": topology.area,
        "robot": _round_pose(topology.pose),
        "statements": [
            [str(one)[:_MAX_STATEMENT], round(one.probability, 4)] for one in topology.statements[-_MAX_STATEMENTS:]
        ],
        "areas": [_area(area) for area in topology.areas],
        "arcs": [_arc(arc, poses[arc.source]) for arc in topology.arcs if arc.source in poses and arc.target in poses],
    }


def alternatives_section(alternatives: Alternatives) -> dict[str, Any]:
    """The maps of the other hypotheses, as changes against the section of :func:`topology_section`.

    :raises HmtSlamError: where they are too large to be shown.
    """
    count = sum(len(h.areas) + len(h.arcs) + len(h.missing_arcs) for h in alternatives.hypotheses)
    if count > _MAX_ARCS:
        raise HmtSlamError(f"maps of other hypotheses with {count} areas and arcs are too large: look who publishes it")
    return {
        "events": alternatives.events,
        "best": alternatives.best,
        "hypotheses": {str(one.hypothesis): _alternative(one) for one in alternatives.hypotheses},
    }


def evidence_section(evidence: Evidence) -> dict[str, list[dict[str, Any]]]:
    """{hypothesis: its steps, each with a title, what speaks for and against it, and its probability then}."""
    return {str(one.hypothesis): [_step(step) for step in one.steps] for one in evidence.hypotheses}


def _step(step: BranchStep) -> dict[str, Any]:
    pro, con = [], []
    if step.matched:
        pro.append(f"{step.matched:.1f} m of walls match")
    if step.contradicting:
        con.append(f"{step.contradicting:.1f} m of walls are seen through")
    if step.prior is not None:
        side = pro if step.prior >= 0.5 else con
        side.append(f"odometry and arcs alone: {_percent(step.prior)}")
    return {
        "event": step.event,
        "title": _TITLES[step.kind].format(area=step.area, other=step.other),
        "ends": [step.area, step.other] if step.kind in ("closure", "withdrawal") else [],
        "probability": round(step.probability, 5),
        "pro": pro,
        "con": con,
    }


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if 0.0005 < share < 0.9995 else f"{100.0 * share:.0f} %"


def _alternative(one: Alternative) -> dict[str, Any]:
    return {
        "area": one.area,
        "robot": _round_pose(one.pose),
        "areas": [
            {"area": area.area, "pose": _round_pose(area.pose)}
            | (
                {"keyframes": list(area.keyframes), "poses": [_round_pose(pose) for pose in area.poses]}
                if area.has_own_keyframes
                else {}
            )
            for area in one.areas
        ],
        "arcs": [{"ends": [arc.source, arc.target], "closure": arc.closure} for arc in one.arcs],
        "missing": [[arc.source, arc.target] for arc in one.missing_arcs],
    }


def _area(area: TopologyArea) -> dict[str, Any]:
    poses = np.round(np.array(area.poses).reshape(-1, 3), 3).tolist()
    text = f"Area {area.area} in the map: {_deviation_text(area.pose)}"
    return {
        "area": area.area,
        "pose": _round_pose(area.pose.mean),
        **_uncertainty(area.pose, area.pose, text),
        "keyframes": list(area.keyframes),
        "poses": poses,
    }


def _arc(arc: TopologyArc, source: PoseGaussian) -> dict[str, Any]:
    closed = ", closed a loop" * arc.closure
    text = f"Area {arc.target} seen from {arc.source}: {_deviation_text(arc.pose)}{closed}"
    in_map = PoseGaussian.from_pose(source.mean).compose(arc.pose)
    return {
        "ends": [arc.source, arc.target],
        "closure": arc.closure,
        "probability": round(arc.probability, 4),
        **_uncertainty(arc.pose, in_map, text),
    }


def _uncertainty(belief: PoseGaussian, in_map: PoseGaussian, text: str) -> dict[str, Any]:
    """The 95 % ellipse and a sentence; no ellipse where the place could be any."""
    if is_uninformative(belief):
        return {"ellipse": None, "text": _UNKNOWN_PLACE}
    return {"ellipse": [round(value, 4) for value in in_map.position_ellipse()], "text": text}


def _deviation_text(belief: PoseGaussian) -> str:
    """Standard deviations: the largest of the position, and that of the heading."""
    turn = math.degrees(math.sqrt(max(0.0, belief.covariance[2, 2])))
    return f"±{belief.position_ellipse().semi_major / ELLIPSE_95:.2f} m, ±{turn:.1f}°"


def _round_pose(pose: Pose) -> list[float]:
    x, y, theta = pose.tolist()
    return [round(x, 3), round(y, 3), round(theta, 4)]
