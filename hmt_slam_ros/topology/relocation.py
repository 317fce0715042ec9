"""Where in the whole map are some keyframes, whatever the arcs say? By the looks of areas, then by their surfaces.

That is the question of a robot that was lost: its wheels slipped where the scans did not tell, or it was carried. Its
prior is flat over all areas, positions in their places, and headings; so an answer counts only where it is the only one
among the areas that look most alike. A building in which every corridor is like the next gives none.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from hmt_slam_ros.agreement import Agreement
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.appearance import Looks, log_ratio
from hmt_slam_ros.topology.area_grid import AreaGrid
from hmt_slam_ros.topology.area_matching import MatchSettings, Mode, match
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.surroundings import Views, stacked
from hmt_slam_ros.topology.transition import Place, owner_at

Pose = NDArray[np.float64]

# Areas whose surfaces are compared, each at the cost of a dozen gated comparisons.
_MOST = 4
# Flat over a place and all headings, m, m, rad.
_FLAT = PoseGaussian(np.zeros(3), np.diag([20.0, 20.0, 20.0]) ** 2)
# Of the samples, one of so many is looked for.
_EVERY = 3
# Share that the best answer has to have of the probability of all, and nats below it that others are looked at.
_ALONE, _MARGIN = 0.9, 5.0
# Deviation of an answer's position at most, m, and share of the surfaces that are known at least.
_SHARP, _KNOWN = 0.2, 0.7
# Of the log-ratio of a sample on a surface, as much on average at least.
_SURE = math.log(3.0)
_LEAST = 0.35 * _SURE
# Likewise of a robot that may be anywhere: what it sees is in the map, or it is not. That little of the map is where it
# sees free space is not asked, as what moved through known ground left its traces there.
_HALF = 0.5 * _SURE
# Deviation of an area's position, m, up to which it is part of a place: keyframes lie across the border of two areas
# also where their arc was travelled over once.
_WIDE = 1.0
# Where so much less of the surfaces is known than in another area, an area does not matter.
_WORSE = 0.15


class Located(NamedTuple):
    """Where keyframes are.

    :ivar area: in whose place.
    :ivar mode: how they lie there.
    :ivar found: their surfaces in the map of the place.
    """

    area: int
    mode: Mode
    found: Agreement


class Relocation:
    """Looks for keyframes in the whole map.

    :param radius: farthest distance to a keyframe of a place, m.
    """

    def __init__(self, views: Views, looks: Looks, settings: MatchSettings, radius: float) -> None:
        self._views, self._looks, self._radius = views, looks, radius
        self._settings = replace(settings, margin=_MARGIN)

    def located(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: float, here: int
    ) -> tuple[Located | None, float]:
        """The one place where the keyframes fit, or None where there is none or several.

        :param poses: {keyframe: ``reference_T_base``} of those in question.
        :param before: the map is that of the keyframes before this one.
        :param here: an area that is looked at in any case.
        :returns: that, and the probability by their looks of the areas that were not looked at.
        """
        found, unseen = self._fits_alike(hybrid_map, poses, before, here)
        if not found:
            return None, unseen
        masses = np.array([fit.mode.log_mass for fit in found])
        best = int(masses.argmax())
        alone = masses[best] - np.logaddexp.reduce(masses) >= math.log(_ALONE)
        known = found[best].found.share >= _KNOWN
        return found[best] if alone and known and is_certain(found[best]) else None, unseen

    def everywhere(
        self,
        hybrid_map: HybridMap,
        poses: Mapping[int, Pose],
        before: float,
        among: Collection[int] | None = None,
    ) -> tuple[list[Located], list[int]]:
        """How the keyframes lie in all areas.

        :param among: none but these, if not all.
        :returns: the fits that matter beside the best, and the areas.
        """
        shares = self.shares(hybrid_map, list(poses), before)
        known = [area for area in shares if among is None or area in among]
        areas = sorted(known, key=lambda area: (-shares[area], area))
        settings = replace(self._settings, reverse=False)
        found: list[Located] = []
        for area in areas:
            best = max((fit.found.share for fit in found), default=0.0)
            place = self._views.place(hybrid_map, area, (), before, _WIDE)
            own = place.positions[place.owners == area]
            found += self._fits(place, poses, own, replace(settings, least=max(_HALF, (best - _WORSE) * _SURE)))
        return found, areas

    def _fits_alike(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: float, here: int
    ) -> tuple[list[Located], float]:
        """How the keyframes lie in the areas that look most like them, and in ``here``.

        :returns: the fits that matter beside the best, and the probability of the other areas by their looks.
        """
        shares = self.shares(hybrid_map, list(poses), before)
        chosen = sorted(shares, key=lambda area: (-shares[area], area))[:_MOST]
        unseen = max(0.0, 1.0 - sum(shares[area] for area in chosen))
        found: list[Located] = []
        for area in dict.fromkeys([*chosen, *sorted(shares.keys() & {here})]):
            best = max((fit.found.share for fit in found), default=0.0)
            place = self._views.place(hybrid_map, area, (), before)
            settings = replace(self._settings, least=max(_LEAST, (best - _WORSE) * _SURE))
            found += self._fits(place, poses, place.positions, settings)
        return found, unseen

    def shares(self, hybrid_map: HybridMap, keyframes: Sequence[int], before: float) -> dict[int, float]:
        """p(gamma | phi): the probability of every area by its look alone; they sum to 1.

        :param before: areas are known by their keyframes before this one.
        """
        known = {area: [k for k in hybrid_map.keyframes(area) if k < before] for area in hybrid_map.area_ids()}
        areas = [area for area, own in known.items() if own]
        likeness = self._looks.likeness(keyframes, [known[area] for area in areas])
        weights = softmax(log_ratio(likeness)) if areas else likeness
        return dict(zip(areas, weights.tolist(), strict=True))

    def _fits(
        self, place: Place, poses: Mapping[int, Pose], positions: NDArray[np.float64], settings: MatchSettings
    ) -> list[Located]:
        """How the keyframes lie in an area's place.

        :param positions: shape (n, 2), near which one of them is.
        """
        query = self._views.grid(poses)
        some, known = (replace(grid, points=grid.points[::_EVERY]) for grid in (query, place.grid))
        settings = replace(settings, temper=_EVERY * settings.temper)
        modes = match(some, known, _FLAT, settings, reach_of(positions, query, poses, self._radius)).modes
        return [
            Located(place.area, mode, place.grid.agreement(query.points, mode.pose.mean))
            for mode in modes
            if owner_at(place, se2.compose(mode.pose.mean, stacked(poses)), self._radius) == place.area
        ]


def is_certain(located: Located) -> bool:
    """Whether the surfaces alone say where, also along corridors."""
    variance = float(np.linalg.eigvalsh(located.mode.measured.covariance[:2, :2])[-1])
    return variance <= _SHARP**2


def reach_of(
    positions: NDArray[np.float64], query: AreaGrid, poses: Mapping[int, Pose], radius: float
) -> NDArray[np.float64]:
    """The smallest and the largest (x, y) of the middle of the query's points where a keyframe of it is near one of
    some positions, shape (2, 2).

    :param positions: shape (n, 2), m.
    :param poses: {keyframe: ``reference_T_base``} of the query.
    :param radius: how near, m.
    """
    middle = query.points.mean(axis=0) if len(query.points) else np.zeros(2)
    lever = float(np.hypot(*(stacked(poses)[:, :2] - middle).T).max())
    reach = radius + lever
    return np.array([positions.min(axis=0) - reach, positions.max(axis=0) + reach])
