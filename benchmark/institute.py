"""Localization over places in an institute: missions and relocations, as in tables 2 and 3 of Tomatis et al. (2003)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import networkx
import numpy as np

from benchmark.institute_maps import PEOPLE, InstituteMap, map_institute, scenario_of
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings, chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.exploration.local_motion import MotionLimits
from hmt_slam_ros.exploration.mission_controller import MissionController, Phase
from hmt_slam_ros.exploration.rooms import Destination, KnownBuilding, destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.place_graph import heading_of, node_of, state_of
from hmt_slam_ros.places.policy import MetricInitialPose
from hmt_slam_ros.places.position_belief import certain_belief
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import RelativeMotion, increment_covariance
from hmt_slam_ros.simulation.drive import ACCELERATION, TURN_ACCELERATION
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import Scenario

SEEDS = 5
"""Buildings."""

MISSIONS = 5
"""In a building."""

TIME = 300.0
"""Of a mission at most, s."""

LEAST = 20.0
"""Way of a mission, where there is a door so far away, m."""

AT_PLACE = 0.3
"""So near to a place the robot has reached it, m."""

_NEAR = 1.0  # m, from a state of the building to the node that is it
_RIGHT, _TURN = 1.0, 1.0  # m and rad, of the place that an estimate says from the true one
_WAY = 0.5 * math.pi
RELOCATIONS = 2
"""In a building."""

FAR, _LOST = 60.0, 300.0
"""Way of a relocation at most, m, and its time, s."""

_AFTER = 3  # nodes without an error after which a recovery counts
_CHANGED = {"as mapped": 0.0, "doors changed": 0.25}
_SUCCESS, _UNCONFIDENT, _FALSE, _CONFIDENT_FALSE, _TRANSITIONS = 1.0, 0.12, 0.014, 0.005, 0.12  # paper, table 2
_METRES, _STATES = 13.7, 2.11  # paper, table 3
_NEES = 2.1, 4.2  # 0.7 to 1.4 for each of 3 degrees of freedom

POLICY = (
    f"In a map that SLAM made of another drive robots go by their belief, with {PEOPLE} people about, a laser that "
    "sees all around and noisy wheels; true poses only score. In hallways the robot keeps to the middle between the "
    "walls that it sees, and turns as the most likely state's policy says; before its goal's door it goes over to the "
    "metric filter if it is confident, starts that with the door's moments, and drives by it to a place in the room "
    "and, for the next mission, back out. An estimate is one scan's, in a hallway while the robot does not turn; it is "
    "right where the place that it says, its most likely node and the way since then, is within 1 m of the robot, and "
    "its direction is the robot's. Missions: five in each building, each from the room of the last one to another room "
    f"whose door is open, {LEAST:g} m away or more; the first begins before a door, in a known state. A success is a "
    f"switch at the door of the goal; a place is reached where within {TIME:g} s the robot says so, and is within "
    f"{AT_PLACE:g} m of it. After a mission without that somebody carries the robot before the door of its goal. "
    "Metres and seconds include the ways in rooms. A transition is a node that the robot notices; it is false where "
    "the estimate after that is wrong. A contact is counted where a step would bring the robot's disc into a surface "
    f"or a person. Relocations: up to {FAR:g} m from a random place in a hallway with a flat belief; the robot goes "
    "straight on, and turns at the end of the hallway to where it expects to learn most, or back; it has recovered at "
    "the first confident and right estimate behind which there is no wrong one up to the third further node. Doors "
    f"changed: {100 * _CHANGED['doors changed']:.0f} % of the open doors were closed and others opened after the map "
    "was made; what is required is of the doors as mapped, as in the paper. Metric start: the pose with which the "
    "metric filter begins, against the true one; NEES has 3 degrees of freedom."
)


def measure_institute(settings: Settings) -> Report:
    """Drive missions and relocate lost robots."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    with ProcessPoolExecutor(settings.records.jobs) as pool:
        buildings = list(pool.map(partial(_measure_building, configuration=configuration), seeds))
    missions = {name: [mission for building in buildings for mission in building[name][0]] for name in _CHANGED}
    relocations = {name: [mission for building in buildings for mission in building[name][1]] for name in _CHANGED}
    report = Report("institute", "Missions and relocations in an institute", seeds=seeds)
    as_mapped = next(iter(_CHANGED))
    report.requirements = [
        *_mission_requirements(missions[as_mapped]),
        *_relocation_requirements(relocations[as_mapped]),
    ]
    report.body += [_mission_table(missions), _relocation_table(relocations), POLICY]
    return report


def _measure_building(seed: int, configuration: Configuration) -> dict[str, tuple[list[Mission], list[list[Estimate]]]]:
    """Missions and relocations in one building, with the doors as mapped and changed."""
    institute = map_institute(seed, configuration)
    scenarios = {name: scenario_of(seed, visit=1, changed=changed) for name, changed in _CHANGED.items()}
    return {
        name: (missions_of(institute, scenario, configuration), relocations_of(institute, scenario, configuration))
        for name, scenario in scenarios.items()
    }


def _mission_requirements(missions: Sequence[Mission]) -> list[Requirement]:
    estimates = [estimate for mission in missions for estimate in mission.estimates]
    false = [not estimate.right for estimate in estimates]
    confident = [estimate.confident and not estimate.right for estimate in estimates]
    nees = [mission.errors[2] for mission in missions if mission.errors is not None]
    return [
        Requirement(
            "missions that succeed", mean_or_nan([estimate.success for estimate in missions]), 1.0, least=_SUCCESS
        ),
        Requirement(
            "missions that reach their place",
            mean_or_nan([estimate.reached for estimate in missions]),
            1.0,
            least=_SUCCESS,
        ),
        Requirement("false state transitions", mean_or_nan(false_transitions(missions)), _TRANSITIONS),
        Requirement(
            "unconfident estimates", mean_or_nan([not estimate.confident for estimate in estimates]), _UNCONFIDENT
        ),
        Requirement("false estimates", mean_or_nan(false), _FALSE),
        Requirement("confident false estimates", mean_or_nan(confident), _CONFIDENT_FALSE),
        Requirement("NEES of the metric start, mean", mean_or_nan(nees), _NEES[1], least=_NEES[0]),
    ]


def false_transitions(missions: Sequence[Mission]) -> list[bool]:
    """Of all nodes that were noticed, whether the estimate after that is wrong."""
    return [
        not after.right
        for mission in missions
        for before, after in zip(mission.estimates[:-1], mission.estimates[1:], strict=True)
        if after.arrivals > before.arrivals
    ]


def _relocation_requirements(runs: Sequence[Sequence[Estimate]]) -> list[Requirement]:
    found = [estimate for run in runs if (estimate := recovery(run)) is not None]
    return [
        Requirement("relocations that recover", len(found) / len(runs), 1.0, least=1.0),
        Requirement(
            "distance for recovering, mean", mean_or_nan([estimate.distance for estimate in found]), _METRES, "m"
        ),
        Requirement("states for recovering, mean", mean_or_nan([estimate.arrivals for estimate in found]), _STATES),
    ]


def _mission_table(missions: dict[str, list[Mission]]) -> str:
    rows = [
        ["Number of missions", "25"],
        ["Success", "25 / 100 %"],
        ["Place in the room reached", "-"],
        ["Contacts", "-"],
        ["Total traveled distance [m]", "899"],
        ["Mean travel distance [m]", "36"],
        ["Mean travel speed [m/s]", "0.31"],
        ["Total state transitions", "181"],
        ["False state transitions", "21 / 12 %"],
        ["Total estimates", "27870"],
        ["Unconfident states", "3413 / 12 %"],
        ["False estimates", "404 / 1.4 %"],
        ["Confident false estimates", "149 / 0.5 %"],
        ["Metric start: mean error [cm]", "-"],
        ["Metric start: mean error [deg]", "-"],
        ["Metric start: NEES, mean", "-"],
    ]
    columns = [_mission_column(own) for own in missions.values()]
    for row, *cells in zip(rows, *columns, strict=True):
        row.extend(cells)
    return table(["missions", "paper", *missions], rows)


def _mission_column(missions: Sequence[Mission]) -> list[str]:
    estimates = [estimate for mission in missions for estimate in mission.estimates]
    distance, seconds = sum(one.distance for one in missions), sum(one.seconds for one in missions)
    errors = np.array([one.errors for one in missions if one.errors is not None]).reshape(-1, 3)
    transitions = false_transitions(missions)
    return [
        str(len(missions)),
        format_share([one.success for one in missions]),
        format_share([one.reached for one in missions]),
        str(sum(one.contacts for one in missions)),
        f"{distance:.0f}",
        f"{distance / len(missions):.0f}",
        f"{distance / seconds:.2f}",
        str(len(transitions)),
        format_share(transitions),
        str(len(estimates)),
        format_share([not one.confident for one in estimates]),
        format_share([not one.right for one in estimates]),
        format_share([one.confident and not one.right for one in estimates]),
        f"{100.0 * mean_or_nan(errors[:, 0]):.1f}",
        f"{math.degrees(mean_or_nan(errors[:, 1])):.2f}",
        f"{mean_or_nan(errors[:, 2]):.2f}",
    ]


def _relocation_table(lost: dict[str, list[list[Estimate]]]) -> str:
    rows = [
        ["Number of experiments", "10"],
        ["Recovered", "10"],
        ["Total traveled distance [m]", "250"],
        ["Mean distance for recovering [m]", "13.7"],
        ["Min / max distance for recovering [m]", "1.21 / 20.31"],
        ["Mean number of states for recovering", "2.11"],
        ["Min / max states for recovering", "1 / 4"],
    ]
    for runs in lost.values():
        found = [estimate for run in runs if (estimate := recovery(run)) is not None]
        distance, states = [one.distance for one in found], [one.arrivals for one in found]
        traveled = sum(run[-1].distance for run in runs if run)
        cells = [
            str(len(runs)),
            str(len(found)),
            f"{traveled:.0f}",
            f"{mean_or_nan(distance):.1f}",
            f"{min(distance, default=math.nan):.2f} / {max(distance, default=math.nan):.2f}",
            f"{mean_or_nan(states):.2f}",
            f"{min(states, default=0)} / {max(states, default=0)}",
        ]
        for row, cell in zip(rows, cells, strict=True):
            row.append(cell)
    return table(["relocations", "paper", *lost], rows)


def mean_or_nan(values: Sequence[float] | Float64) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def format_share(values: Sequence[bool]) -> str:
    return f"{sum(values)} / {100.0 * mean_or_nan(values):.1f} %" if values else "-"


class Estimate(NamedTuple):
    """A belief and what is true.

    :ivar arrivals: openings noticed so far.
    :ivar distance: traveled so far.
    :ivar probability: of the most likely state.
    :ivar confident: whether the belief is.
    :ivar right: whether that state is the true one.
    """

    arrivals: int
    distance: float
    probability: float
    confident: bool
    right: bool


class Mission(NamedTuple):
    """A drive to a named place.

    :ivar success: whether the robot was confident before the door of its goal, and went over to the metric filter.
    :ivar reached: whether it is at the place in the room then, as it says.
    :ivar distance: driven.
    :ivar seconds: of the simulation.
    :ivar contacts: how often it came upon something.
    :ivar estimates: on the way.
    :ivar errors: of the metric start at the door, m, rad and NEES; None where there was none.
    """

    success: bool
    reached: bool
    distance: float
    seconds: float
    contacts: int
    estimates: list[Estimate]
    errors: tuple[float, float, float] | None


class BeliefDrivenRobot:
    """A driven robot that its belief steers.

    :ivar estimates: at every scan in a hallway, while the robot does not turn.
    """

    def __init__(
        self,
        institute: InstituteMap,
        scenario: Scenario,
        configuration: Configuration,
        start: Float64,
        state: int | None = None,
    ) -> None:
        """:param start: ``world_T_base`` (3,).

        :param state: that the robot knows to be in, None for one that is lost.
        """
        settings = scenario.settings
        limits = MotionLimits(
            settings.speed,
            math.radians(settings.turn_rate),
            ACCELERATION,
            TURN_ACCELERATION,
            settings.radius,
            period=1.0 / settings.rate,
        )
        self._institute, self._configuration = institute, configuration
        self._known = known_building(institute, configuration)
        self.robot = DrivenRobot(scenario, start)
        belief = None if state is None else certain_belief(self._known.graph, configuration.places, state)
        self.pilot = MissionController(self._known, configuration, limits, belief)
        self.estimates: list[Estimate] = []
        self._wheels: Float64 | None = None

    def mission(self, goal: Destination) -> Mission:
        """Drive to a place."""
        robot, pilot = self.robot, self.pilot
        begin, distance, contacts = robot.stamp, robot.distance_traveled, robot.contacts
        self.estimates, found = [], None
        pilot.start_mission(goal)
        while robot.stamp < begin + TIME * NANOSECONDS and pilot.phase not in {Phase.THERE, Phase.LOST}:
            before, pose = pilot.initial_pose, robot.pose
            self.step()
            if pilot.initial_pose is not before and pilot.initial_pose is not None:
                found = pilot.initial_pose.node, self._errors(pilot.initial_pose, pose)
        place = se2.transform(self._institute.frames[goal.opening.area], goal.position[None])[0]
        reached = pilot.phase is Phase.THERE and math.dist(place, robot.pose[:2]) <= AT_PLACE
        success = found is not None and found[0] == goal.node
        return Mission(
            success,
            reached,
            robot.distance_traveled - distance,
            (robot.stamp - begin) / NANOSECONDS,
            robot.contacts - contacts,
            self.estimates,
            None if found is None else found[1],
        )

    def step(self) -> None:
        """Measure, and drive on until there is more to measure."""
        odometry, scan = self.robot.measure()
        if scan is not None:
            self._steer(odometry, scan)
        self.robot.advance()

    def _steer(self, odometry: Odometry, scan: Scan) -> None:
        if self._wheels is not None:
            increment = se2.between(self._wheels, odometry.pose)
            self.pilot.predict(RelativeMotion(increment, increment_covariance(increment, self._configuration.motion)))
        self._wheels = odometry.pose.copy()
        command = self.pilot.steer(scan)
        self.robot.set_velocity(command.speed, command.turn_rate)
        estimator = self.pilot.estimator
        belief = estimator.belief
        if self.pilot.room is None and belief is not None and estimator.is_in_hallway and not estimator.is_turning:
            right = is_right(self._institute, estimator, self.robot.pose)
            peak = float(belief.probabilities.max())
            self.estimates.append(
                Estimate(estimator.arrivals, self.robot.distance_traveled, peak, belief.is_confident, right)
            )

    def _errors(self, start: MetricInitialPose, pose: Float64) -> tuple[float, float, float]:
        true = se2.between(self._institute.frames[start.area], pose)
        off = se2.log(se2.between(start.pose.mean, true))
        nees = float(off @ np.linalg.solve(start.pose.covariance, off))
        return math.hypot(off[0], off[1]), abs(float(off[2])), nees


def known_building(institute: InstituteMap, configuration: Configuration) -> KnownBuilding:
    """What the robot knows of an institute."""
    graph = institute.chart.graph(configuration.places)
    return KnownBuilding(institute.chart, graph, institute.hybrid_map, institute.scans)


def is_right(institute: InstituteMap, estimator: PlaceEstimator, pose: Float64) -> bool:
    """Whether the most likely place, which is a node and the way since then, is that of the robot.

    :param pose: ``world_T_base`` (3,).
    """
    belief = estimator.belief
    state = None if belief is None else belief.most_likely_state
    if state is None:
        return False
    off = se2.between(axis_of(institute, state), pose)
    near = math.hypot(off[0] - estimator.frame.distance_past_node, off[1]) <= _RIGHT
    return near and abs(float(off[2])) <= _TURN


def axis_of(institute: InstituteMap, state: int) -> Float64:
    """True pose of a robot in a state, shape (3,)."""
    node = institute.nodes[node_of(state)]
    return np.array((*node[:2], float(se2.wrap(node[2] - _WAY * heading_of(state)))))


def missions_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[Mission]:
    """From room to room; where one fails, somebody carries the robot before the door of its goal."""
    random = np.random.default_rng([scenario.settings.seed, 1])
    places = destinations(known_building(institute, configuration))
    doors = open_doors(institute, scenario, places)
    start, steered, missions = int(random.choice(doors)), None, []
    for _ in range(MISSIONS):
        goal = _next_stop(random, institute, doors, start)
        if steered is None:
            state = _departure_state(institute, start, goal)
            steered = BeliefDrivenRobot(institute, scenario, configuration, axis_of(institute, state), state)
        missions.append(steered.mission(places[goal]))
        if not missions[-1].reached:
            steered = None
        start = goal
    return missions


def open_doors(institute: InstituteMap, scenario: Scenario, places: Mapping[int, Destination]) -> list[int]:
    """The nodes of the chart with places behind doors that are open at a visit.

    :param places: {node: the place behind its door}.
    """
    states = scenario.building.states
    doors = states.poses[~states.crossings]
    return [node for node, place in places.items() if _is_open(doors, institute, place)]


def _is_open(doors: Float64, institute: InstituteMap, place: Destination) -> bool:
    """Whether the door of a place is one of some open ones (n, 3); one opposite it is another one."""
    opening = place.opening
    heading = se2.compose(institute.frames[opening.area], opening.landmark.pose.mean)[2]
    near = np.hypot(*(doors[:, :2] - institute.nodes[place.node, :2]).T) <= _NEAR
    return bool((near & (np.abs(se2.wrap(doors[:, 2] - heading)) <= _TURN)).any())


def _next_stop(random: np.random.Generator, institute: InstituteMap, doors: Sequence[int], stop: int) -> int:
    """One of the doors that are far away, or the farthest."""
    ways = {door: way_length(institute, stop, door) for door in doors if door != stop}
    far = [door for door, length in ways.items() if length >= LEAST]
    return int(random.choice(far or [max(ways, key=lambda door: ways[door])]))


def _departure_state(institute: InstituteMap, start: int, goal: int) -> int:
    """The state of a robot that leaves a node on the shortest way to another one."""
    first = networkx.shortest_path(_place_graph(institute), start, goal, weight="length")[1]
    edges = institute.chart.edges
    direction = next(edge.start_direction for edge in edges if (edge.start, edge.end) == (start, first))
    return state_of(start, direction)


def way_length(institute: InstituteMap, node: int, goal: int) -> float:
    """Of the shortest way from one node to another one, m."""
    return float(networkx.shortest_path_length(_place_graph(institute), node, goal, weight="length"))


def _place_graph(institute: InstituteMap) -> networkx.Graph:
    ways = networkx.Graph()
    for edge in institute.chart.edges:
        ways.add_edge(edge.start, edge.end, length=edge.distance[0])
    return ways


def relocations_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[list[Estimate]]:
    """The estimates of robots that are lost at first."""
    random = np.random.default_rng([scenario.settings.seed, 2])
    return [_drive_relocation(institute, scenario, configuration, random) for _ in range(RELOCATIONS)]


def _drive_relocation(
    institute: InstituteMap, scenario: Scenario, configuration: Configuration, random: np.random.Generator
) -> list[Estimate]:
    edges = list({(edge.start, edge.start_direction): edge for edge in institute.chart.edges}.values())
    lengths = np.array([edge.distance[0] for edge in edges])
    edge = edges[int(random.choice(len(lengths), p=lengths / lengths.sum()))]
    ahead = np.array((random.uniform(0.2, 0.8) * edge.distance[0], 0.0, 0.0))
    start = se2.compose(axis_of(institute, state_of(edge.start, edge.start_direction)), ahead)
    steered = BeliefDrivenRobot(institute, scenario, configuration, start)
    steered.pilot.start_mission(None)
    end = steered.robot.stamp + _LOST * NANOSECONDS
    while steered.robot.distance_traveled < FAR and steered.robot.stamp < end and recovery(steered.estimates) is None:
        steered.step()
    return steered.estimates


def recovery(estimates: Sequence[Estimate]) -> Estimate | None:
    """The first confident and right estimate with none wrong at the next nodes; None as long as there is none."""
    first: Estimate | None = None
    for k, estimate in enumerate(estimates):
        if not estimate.right:
            first = None
        elif first is None and estimate.confident:
            first = estimate
        last = k + 1 == len(estimates) or estimates[k + 1].arrivals > estimate.arrivals
        if first is not None and last and estimate.arrivals - first.arrivals >= _AFTER:
            return first
    return None
