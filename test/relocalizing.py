"""Lost robots and what searches of their pose found, for tests of relocalization."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.topological_inference import pose_verification, relocalization
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.candidate_gating import CandidateGating
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.global_localization import GlobalSearch
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    HypothesisState,
)
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution
from hmt_slam_ros.topological_inference.search_prior import FLAT_PRIOR, SearchPrior

OPTIONS = replace(Configuration().tsbi, relocalization_probability=0.8, relocalization_share=0.6, hint_probability=0.7)
ARC = np.array([3.0, 1.0, 0.7])
SHARP, WIDE = np.diag([0.1, 0.1, 0.02]) ** 2, np.diag([0.1, 0.3, 0.02]) ** 2
KIDNAPPED_UNMAPPED = pose_verification.KIDNAPPED_UNMAPPED_PRIOR


def make_map():
    """Areas 0 and 1, joined by an arc, 2 apart, and 5, in which the robot is lost, with keyframes 20 to 25."""
    hybrid_map = HybridMap()
    for area in range(3):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    hybrid_map.set_arc(0, 1, PoseGaussian(ARC, 0.01 * np.eye(3)), closure=False)
    for k in range(6):
        hybrid_map.set_keyframe(20 + k, 5, se2.compose([1.0, 0.5, 0.2], [0.3 * k, 0.1 * k, 0.05 * k]))
    return hybrid_map


def make_parent(localization, hybrid_map=None, **changes):
    state = HypothesisState(localization=localization)
    return replace(Parent(4, 5, hybrid_map or make_map(), state, -0.7), **changes)


def candidate(area, pose, matched=0.9, covariance=SHARP):
    pose = np.array(pose)
    mode = MatchMode(PoseGaussian(pose, covariance), PoseGaussian(pose, covariance), 0.0)
    return PoseCandidate(area, mode, Agreement(100, round(100 * matched), 0))


def distribution(*pairs):
    return PoseDistribution(tuple(each for each, _ in pairs), np.array([p for _, p in pairs]))


class GivenSearch(SimpleNamespace):
    """Branching whose search finds a distribution that is given, after some events."""

    def __init__(self, events=1, **given):
        super().__init__(first_areas=[], remaining=events, unexamined={}, marked=None, **given)
        self.search = SimpleNamespace(gating=CandidateGating(OPTIONS))
        self.map_search = SimpleNamespace(
            work=EventWork(),
            check_candidates=lambda _map, search, _clutter, _prior=None: (search, True),
            begin=self.begin,
            continue_search=self.go_on,
            search_now=lambda hybrid_map, search, area, _clutter: self.go_on(hybrid_map, search, area),
            plausible_areas=lambda _map, _found: frozenset({1, 2}),
            is_conclusive=lambda _map, _search, _clutter, _prior=None: self.remaining == 0,
        )

    def begin(self, _hybrid_map, poses, before, prior=FLAT_PRIOR, only=()):
        self.requested, self.only = (poses, before, prior.hint), only
        return GlobalSearch(poses, before, 3, dict(self.unexamined), self.found.candidates)

    def go_on(self, _hybrid_map, search, first=None, _prior=None):
        self.first_areas.append(first)
        self.remaining -= 1
        return search if self.remaining else replace(search, unexamined={})

    def find_search_prior(self, _parent, lost, poses):
        return FLAT_PRIOR if lost.pose_hint is None else SearchPrior(lost.pose_hint.at_first(poses))

    def is_marked(self, keyframes, before):
        assert min(keyframes) >= before
        return self.marked in keyframes

    def localize_globally(self, _parent, search, prior=FLAT_PRIOR):
        assert search.poses is self.requested[0]
        assert (prior.hint is None) is (self.requested[2] is None)
        return self.found


def search(lost, *pairs, **changes):
    branching = GivenSearch(options=OPTIONS, found=distribution(*pairs))
    parent = make_parent(lost, **changes)
    return branching, parent, relocalization.update_relocalization(branching, parent)
