"""Looks of a lost robot at the map of a part of a drive: where it may be, and what landmarks say of that."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmark.landmark_scans import keyframes_of
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import stacked
from hmt_slam_ros.landmarks.area_classes import AreaKinds
from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.offline.runtime import Run
from hmt_slam_ros.places.area_views import AreaViews
from hmt_slam_ros.places.relocalization_prior import PlacePrior
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch
from hmt_slam_ros.topological_inference.global_localization import Whereabouts
from hmt_slam_ros.topological_inference.global_scan_matching import Located

Array = NDArray[np.float64]

LOOKS, KEYFRAMES = 15, 6
"""Looks from inside of each map, and as many from outside; and keyframes that the robot saw until then."""

INSIDE, OUTSIDE = 1.0, 4.0
"""Who is inside is so near to one of the map's keyframes, m, who is outside as far from all."""

RIGHT, RIGHT_ANGLE = 1.0, math.radians(20.0)
"""By which a right place is off at most, m and rad."""

_DRIFT = np.array([0.01, 0.01, math.radians(0.2)])  # from keyframe to keyframe, m, m, rad
_DRAWS = 2011
# Scans within which the robot has seen as many keyframes, or stands still.
_MOST = 400


class Drive(NamedTuple):
    """A drive through a building.

    :ivar records: of its log.
    :ivar scans: shape (n,), stamps of its scans, in their order, ns.
    :ivar poses: shape (n, 3), their true ``world_T_base``.
    :ivar scan: {number: scan}.
    """

    records: Iterable[LogRecord]
    scans: NDArray[np.int64]
    poses: Array
    scan: Callable[[int], Scan]


class Look(NamedTuple):
    """A look.

    :ivar inside: whether the robot is where the map reaches.
    :ivar where: by surfaces alone.
    :ivar right: shape (n,), which of the places are right.
    :ivar ratios: shape (n,), what landmarks say of them, nats; zeros where they say nothing.
    :ivar kinds: shape (n,), what being in a hallway or in a room says of them, nats.
    :ivar seconds: CPU time of surfaces and of landmarks.
    """

    inside: bool
    where: Whereabouts
    right: NDArray[np.bool_]
    ratios: Array
    kinds: Array
    seconds: tuple[float, float]


class Part(NamedTuple):
    """The map of a part of a drive.

    :ivar hybrid_map: of the most probable hypothesis.
    :ivar scans: {keyframe: scan}.
    :ivar clutter: what contradicts the map usually, as metric SLAM has learnt.
    :ivar last: number of the last scan of the part.
    """

    hybrid_map: HybridMap
    scans: dict[int, Scan]
    clutter: Clutter
    last: int


def simulated_drive(name: str) -> Drive:
    """A drive through a simulated building.

    :param name: of the log.
    """
    log = open_simulated(name)
    stamps = log.scenario.scan_stamps
    return Drive(log.records(), stamps, log.scenario.true_poses(stamps), log.scenario.scan)


def mapped_part(run: Run, last: int) -> Part:
    """What a run has mapped up to a scan."""
    replica = Replica.of(run.state.tsbi.replica)
    leaves = run.recorder.keyframes[max(run.recorder.keyframes)].leaves
    # A hypothesis of which no keyframe was said yet has its parent's.
    clutter = next((leaf.clutter for leaf in leaves if leaf.hypothesis == replica.best), leaves[0].clutter)
    return Part(replica.maps[replica.best], dict(replica.scans), clutter, last)


def map_of(drive: Drive, last: int, configuration: Configuration) -> Part:
    """Map a drive up to a scan."""
    run = Run(configuration)
    for record in drive.records:
        if record.measurement.stamp > drive.scans[last]:
            break
        run.read(record)
    return mapped_part(run, last)


class Looks:
    """Makes looks at the map of a part of a drive."""

    def __init__(self, drive: Drive, part: Part, configuration: Configuration) -> None:
        self._drive, self._part, self._configuration = drive, part, configuration
        self._scans, self._before = dict(part.scans), max(part.scans) + 1
        mapping = LocalMapping(configuration)
        self._search = ClosureSearch(configuration, self._scans)
        self._prior = PlacePrior(configuration, AreaViews(mapping, self._scans))
        self._kinds = AreaKinds(mapping)
        numbers = {stamp: n for n, stamp in enumerate(drive.scans.tolist())}
        self._true = {k: drive.poses[numbers[scan.stamp]] for k, scan in part.scans.items()}

    def taken(self, again: int, most: int = LOOKS) -> Iterator[Look]:
        """Looks from inside and from outside.

        :param again: number of the scan from which on those from inside are taken.
        :param most: of either.
        """
        draw = np.random.default_rng([_DRAWS, self._configuration.seed])
        for inside, first in ((True, again), (False, self._part.last)):
            for numbers in self._starts(inside, first, draw, most):
                drift = np.cumsum(_DRIFT * draw.standard_normal((len(numbers), 3)), axis=0)
                yield self._looked(numbers, drift, inside)

    def _starts(self, inside: bool, first: int, draw: np.random.Generator, wanted: int) -> Iterator[list[int]]:
        """The scans that a robot sees, one after the other, in the map or outside."""
        poses, known = self._drive.poses, np.array(list(self._true.values()))
        away = cKDTree(known[:, :2]).query(poses[:, :2])[0]
        for start in draw.permutation(np.arange(first, len(poses))).tolist():
            numbers = [start + k for k in keyframes_of(poses[start:][:_MOST], self._configuration)[:KEYFRAMES]]
            apart = away[numbers]
            if len(numbers) == KEYFRAMES and ((apart <= INSIDE) if inside else (apart >= OUTSIDE)).all():
                yield numbers
                wanted -= 1
            if not wanted:
                return

    def _looked(self, numbers: Sequence[int], drift: Array, inside: bool) -> Look:
        """What a robot that saw some scans makes of them.

        :param drift: shape (len(numbers), 3), by which its odometry is off, m, m and rad.
        """
        hybrid_map, poses = self._part.hybrid_map, self._drive.poses
        seen = dict(enumerate(numbers, start=self._before))
        self._scans.update({k: self._drive.scan(n) for k, n in seen.items()})
        placed = se2.compose(se2.between(poses[numbers[0]], poses[list(numbers)]), drift)
        asked = dict(zip(seen, placed, strict=True))
        begin = time.process_time()
        where = self._search.everywhere(hybrid_map, asked, self._before, self._part.clutter)
        middle = time.process_time()
        ratios = self._prior.log_ratios(hybrid_map, asked, self._before, where.found)
        spent = middle - begin, time.process_time() - middle
        self._search.found()
        at = poses[numbers[-1]]
        right = np.array([self._is_right(one, placed[-1], at) for one in where.found], dtype=np.bool_)
        kinds = self._by_kind(list(seen), placed, where.found)
        return Look(inside, where, right, np.zeros(len(right)) if ratios is None else ratios, kinds, spent)

    def _by_kind(self, seen: Sequence[int], placed: Array, found: Sequence[Located]) -> Array:
        """What it says of places that a robot is in a hallway or in a room, shape (len(found),), nats."""
        here = self._hallway(dict(zip(seen, placed, strict=True)))
        known = [probability for probability in self._hallways.values() if probability is not None]
        # One more area of either kind is taken for granted.
        share = (1.0 + sum(known)) / (2.0 + len(known))
        return np.array([same_kind(here, self._hallways[one.area], share) for one in found])

    def _hallway(self, keyframes: Mapping[int, Array]) -> float | None:
        """The probability of keyframes to be in a hallway; None where they do not tell."""
        kind = self._kinds.of([self._scans[k] for k in keyframes], stacked(keyframes))
        return None if kind is None else kind.probability

    @cached_property
    def _hallways(self) -> dict[int, float | None]:
        """{area of the map: its probability to be a hallway}."""
        hybrid_map = self._part.hybrid_map
        return {area: self._hallway(hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()}

    def _is_right(self, located: Located, newest: Array, at: Array) -> bool:
        """Whether a place is where the robot is, by the keyframe of the area that is nearest to it.

        :param newest: ``reference_T_base`` of the newest keyframe, shape (3,).
        :param at: its true ``world_T_base``.
        """
        placed = self._part.hybrid_map.keyframes(located.area)
        pose = se2.compose(located.mode.pose.mean, newest)
        nearest = min(placed, key=lambda k: math.dist(placed[k][:2], pose[:2]))
        off = se2.between(at, se2.compose(self._true[nearest], se2.between(placed[nearest], pose)))
        return bool(math.hypot(off[0], off[1]) <= RIGHT and abs(off[2]) <= RIGHT_ANGLE)


def same_kind(here: float | None, there: float | None, share: float) -> float:
    """log p(both are what they are | they are one place) / p(it | they are any two), nats; 0 where one is not known.

    :param here: probability to be in a hallway.
    :param there: likewise, of a place.
    :param share: of hallways in the building.
    """
    if here is None or there is None:
        return 0.0
    return math.log(here * there / share + (1.0 - here) * (1.0 - there) / (1.0 - share))
