"""Maps of scripted drives through a simulated institute, and their charts compared with the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import stack_poses
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.places.area_views import AreaView, AreaViewCache
from hmt_slam_ros.places.chart import CROSSING, END, Chart, build_chart
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.submap.local_mapping import LocalMapping

LASER = "field_of_view=360,beams=720"
"""The laser of the paper's robot."""

PEOPLE = 4
"""Number of people."""

NEAR = 1.0
"""Largest distance from a state to the node of the chart that is it, m."""


class InstituteMap(NamedTuple):
    """A map of a drive through all hallways and open rooms.

    :ivar scenario: the drive.
    :ivar hybrid_map: the map at its end.
    :ivar scans: {keyframe: scan}.
    :ivar views: {area: view of its keyframes}.
    :ivar chart: of the map.
    :ivar frames: {area: ``world_T_area`` (3,)}, the best fit to the true poses of the area's keyframes.
    """

    scenario: Scenario
    hybrid_map: HybridMap
    scans: Mapping[int, Scan]
    views: Mapping[int, AreaView]
    chart: Chart
    frames: dict[int, Float64]

    @property
    def nodes(self) -> Float64:
        """True poses of the chart's nodes, shape (n, 3)."""
        poses = [se2.compose(self.frames[node.area], node.pose) for node in self.chart.nodes]
        return np.array(poses).reshape(-1, 3)


class ChartScores(NamedTuple):
    """The scores of a chart.

    :ivar states: number of true states.
    :ivar detected: number of true states that have a node.
    :ivar confused: number of nodes of a wrong kind, or at no state.
    :ivar offsets: distances of nodes from their states, m.
    """

    states: int
    detected: int
    confused: int
    offsets: list[float]


def scenario_of(seed: int, visit: int = 0, changed: float = 0.0, people: int = PEOPLE) -> Scenario:
    """An institute at a visit before which some doors may have been closed and others opened."""
    own = f"seed={seed},visit={visit},changed={changed:g},laps=1,people={people},{LASER}"
    return open_simulated(f"sim:institute,{own}").scenario


def map_institute(seed: int, configuration: Configuration, visit: int = 0, people: int = PEOPLE) -> InstituteMap:
    """Map the scripted drive."""
    own = f"seed={seed},visit={visit},changed=0,laps=1,people={people},{LASER}"
    log = open_simulated(f"sim:institute,{own}")
    result = run_log(log, configuration, compact_record=True)
    recording = result.recorder.finish(
        result.log_progress.stamps, result.log_progress.first_scans, result.log_progress.earlier_trajectory
    )
    return chart_map(log.scenario, recording.hybrid_map, recording.replica.scans, log.true_poses, configuration)


def chart_map(
    scenario: Scenario,
    hybrid_map: HybridMap,
    scans: Mapping[int, Scan],
    true_poses: Callable[[Int64], Float64],
    configuration: Configuration,
) -> InstituteMap:
    """Make the chart of a map.

    :param scans: {keyframe: scan}.
    :param true_poses: gives ``world_T_base`` (n, 3) at stamps (n,), ns.
    """
    views = AreaViewCache(LocalMapping(configuration), scans).views_of_map(hybrid_map)
    frames = {}
    for area in hybrid_map.area_ids():
        own_poses = hybrid_map.keyframes(area)
        true_poses_of_keyframes = true_poses(np.array([scans[keyframe].stamp for keyframe in own_poses]))
        frames[area] = se2.best_fit(stack_poses(own_poses), true_poses_of_keyframes)
    return InstituteMap(
        scenario, hybrid_map, scans, views, build_chart(hybrid_map, views, configuration.features), frames
    )


def score_chart(institute: InstituteMap) -> ChartScores:
    """Compare a chart with the truth."""
    states, nodes = institute.scenario.building.states, institute.chart.nodes
    distances = np.hypot(*(institute.nodes[:, None, :2] - states.poses[None, :, :2]).transpose(2, 0, 1))
    inner = np.array([node.kind != END for node in nodes])
    crossing = np.array([node.kind == CROSSING for node in nodes])
    nearest = distances.argmin(axis=1)
    near = inner & (distances.min(axis=1) <= NEAR)
    is_right = near & (states.crossings[nearest] == crossing)
    detected = len(set(nearest[near].tolist()))
    offsets = distances[near].min(axis=1).tolist()
    return ChartScores(len(states.poses), detected, int((inner & ~is_right).sum()), offsets)
