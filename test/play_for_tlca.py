"""For tests of TLCA: slam and TSBI played by hand."""

from dataclasses import replace

import numpy as np
import worlds

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, HypothesisEstimate, Keyframe, Notice
from hmt_slam_ros.registration.consistency import Clutter

WORLD = worlds.two_rooms()
SPREAD = np.diag([0.1**2, 0.1**2, 0.02**2])
HOME = np.array([1.0, 2.0, 0.0])  # where the map's frame lies in the world


def belief(pose, spread=SPREAD):
    return PoseGaussian(np.asarray(pose, dtype=np.float64), np.asarray(spread))


class Play:
    """TLCA with slam and TSBI played: keyframes are stored where the hypotheses have them, one after another."""

    def __init__(self, refinement=0, **changes):
        options = {"accept_keyframes": 3, "accept_distance": 1.0, "accept_probability": 0.9} | changes
        named = {f"tlca.{name}": value for name, value in options.items()}
        self.configuration = with_changes(Configuration(), named | {"refinement.iterations": refinement})
        self.process = Tlca(self.configuration)
        self.k = -1
        self.notices, self.ambiguities = [], []

    def step(self, *hypotheses, places=None, world=HOME, travelled=None):
        """One keyframe event: ``places`` are (hypothesis, area, area_T_base) before it, ``hypotheses`` TSBI's answer.

        Without places the keyframe is at the origin of the robot's area, and is the first of an area that is new.
        """
        self.k += 1
        if places is None:
            replica = self.process._replica
            places = [(h, area, np.zeros(3)) for h, area in replica.robot_areas.items()]
            hypotheses = [self._with_first_keyframe(hypothesis, replica) for hypothesis in hypotheses]
        estimates = tuple(
            HypothesisEstimate(h, area, belief(pose), True, 0.0, 0.0, Clutter(), 12.0) for h, area, pose in places
        )
        travelled = 0.5 * self.k if travelled is None else travelled
        assert self.process.handle(Keyframe(self.k, worlds.scan_at(WORLD, world), travelled, estimates)) == []
        answers = self.process.handle(Hypotheses(self.k, tuple(hypotheses) or (Hypothesis(0, 0, 1.0, 0),)))
        verdicts = [message for message in answers if isinstance(message, ClosureDecision)]
        self.notices += [message for message in answers if isinstance(message, Notice)]
        self.ambiguities += [message for message in answers if isinstance(message, Ambiguity)]
        assert len(verdicts) == 1
        assert verdicts[0].sequence == self.k
        return verdicts[0]

    def _with_first_keyframe(self, hypothesis, replica):
        if hypothesis.moved_keyframes or hypothesis.area in (0, *replica.maps[hypothesis.parent].area_ids()):
            return hypothesis
        return replace(
            hypothesis,
            moved_keyframes=(
                MovedKeyframe(self.k, replica.robot_areas[hypothesis.parent], hypothesis.area, np.zeros(3)),
            ),
        )

    def start(self):
        return self.step(places=[(0, 0, np.zeros(3))])

    def arc(self, a, b, hypothesis=0):
        return self.process._replica.maps[hypothesis].arc(a, b)


def new_area(hypothesis, parent, probability, area, pose, source=0):
    """A hypothesis whose newest keyframe leaves ``source`` for the new ``area`` at ``source_T_area``."""
    arc = Arc(source, area, belief(pose))
    return Hypothesis(hypothesis, parent, probability, area, belief(se2.inverse(pose)), (), (arc,))


def poses_of(verdict):
    return {given.area: given.pose for given in verdict.global_poses}
