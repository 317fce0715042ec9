"""How well does the look of a place tell it from the others of its building? On training worlds, with the constants."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.evidence import fitted
from benchmark.report import Report, table
from benchmark.settings import Settings
from benchmark.simulated.truth import RADIUS
from benchmark.simulated.worlds import FAMILIES, World, seeds
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.topological_inference.place_recognition import RATIO_AT_MEDIAN, RATIO_SLOPE, Looks, log_ratio

SEEDS = 4
"""Training worlds of every family."""

MOST = 4
"""Areas that look most alike: is the right one among them?"""

_STEP, _TURN = 0.5, math.radians(20.0)  # between keyframes
_AREA, _ASKED = 10, 6  # keyframes of an area, and of a question
_APART = 5.0  # m, of places that are surely others
_FEWEST = 8  # areas to choose from

POLICY = (
    f"Keyframes every {_STEP:g} m or {math.degrees(_TURN):.0f} degrees of a drive, {_AREA} of which in a row are an "
    f"area and {_ASKED} a question, which is asked of all areas before it. An area is right where half of the "
    f"question's keyframes are in its place, and another where none is within {_APART:g} m. Told apart: probability "
    "that the right area of a question looks more alike than another one (area under the ROC curve, mean of the "
    f"questions). Among the {MOST}: share of the questions in which a right area is among the {MOST} that look most "
    "alike, and where these are drawn by chance. The log-likelihood ratio is that of a logistic regression in which "
    "right and other areas have the same weight."
)


class Question(NamedTuple):
    """Keyframes of which it is asked where they were taken.

    :ivar likeness: shape (n,), of the areas before.
    :ivar right: shape (n,), which of them are right.
    :ivar wrong: shape (n,), which are surely others.
    """

    likeness: NDArray[np.float64]
    right: NDArray[np.bool_]
    wrong: NDArray[np.bool_]

    @property
    def told_apart(self) -> float:
        """Probability that a right one looks more alike than a wrong one."""
        right, wrong = self.likeness[self.right][:, None], self.likeness[self.wrong][None]
        return float(np.mean(right > wrong) + 0.5 * np.mean(right == wrong))

    @property
    def among_most(self) -> bool:
        """Whether a right one is among those that look most alike."""
        return bool(self.right[np.argsort(-self.likeness, kind="stable")[:MOST]].any())

    @property
    def by_chance(self) -> float:
        """Probability of that if they were drawn."""
        count = self.right.size
        return 1.0 - math.comb(count - int(self.right.sum()), MOST) / math.comb(count, MOST)


def measure_appearance(settings: Settings) -> Report:
    """Ask for the places of drives through training worlds by their looks alone."""
    chosen = seeds(len(settings.seeds_or(SEEDS)), training=True)
    asked = {
        family: [question for seed in chosen for question in questions(World(family, seed))]
        for family in settings.logs_or(FAMILIES)
    }
    report = Report("appearance", "What the look of a place tells", seeds=chosen)
    report.body += [_families_table(asked), _ratio_table([q for own in asked.values() for q in own]), POLICY]
    return report


def questions(world: World) -> Iterator[Question]:
    """Those of a drive that have a right answer."""
    log = open_simulated(world.log)
    stamps, poses = log.scenario.scan_stamps, log.true_poses(log.scenario.scan_stamps)
    taken = _keyframes(poses)
    looks = Looks({k: log.scenario.scan(scan) for k, scan in enumerate(taken)})
    same = log.same_place(stamps[taken], stamps[taken], RADIUS)
    at = poses[taken, :2]
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    for first in range(0, len(taken) - _ASKED, _ASKED):
        asked = range(first, first + _ASKED)
        areas = [range(k, k + _AREA) for k in range(0, first - 2 * _AREA, _AREA)]
        right = np.array([2.0 * same[np.ix_(asked, area)].any(axis=1).mean() >= 1.0 for area in areas], dtype=np.bool_)
        wrong = np.array([apart[np.ix_(asked, area)].min() > _APART for area in areas], dtype=np.bool_)
        if len(areas) >= _FEWEST and right.any() and wrong.any():
            yield Question(looks.likeness(asked, areas), right, wrong)


def _keyframes(poses: NDArray[np.float64]) -> list[int]:
    taken = [0]
    for k, pose in enumerate(poses):
        away = se2.between(poses[taken[-1]], pose)
        if math.hypot(away[0], away[1]) >= _STEP or abs(away[2]) >= _TURN:
            taken.append(k)
    return taken


def _families_table(asked: dict[str, list[Question]]) -> str:
    rows = [
        [
            family,
            str(len(own)),
            f"{np.mean([q.told_apart for q in own]):.3f}",
            f"{np.mean([q.among_most for q in own]):.2f}",
            f"{np.mean([q.by_chance for q in own]):.2f}",
        ]
        for family, own in asked.items()
        if own
    ]
    return table(["family", "questions", "told apart", f"right among the {MOST}", "by chance"], rows)


def _ratio_table(asked: list[Question]) -> str:
    """The constants as fitted and in use, and the weight that what is in use deserves."""
    likeness = np.concatenate([np.concatenate((q.likeness[q.right], q.likeness[q.wrong])) for q in asked])
    right = np.concatenate([np.repeat((True, False), (q.right.sum(), q.wrong.sum())) for q in asked])
    weights = np.where(right, 0.5 / right.mean(), 0.5 / (1.0 - right.mean()))
    constant, slope = fitted(likeness[:, None], right, weights)[0]
    deserved = fitted(log_ratio(likeness)[:, None], right, weights)[0][1]
    rows = [
        ["fitted", f"{constant:.2f}", f"{slope:.2f}", ""],
        ["in use", f"{RATIO_AT_MEDIAN:.2f}", f"{RATIO_SLOPE:.2f}", f"{deserved:.2f}"],
    ]
    return table(["log-likelihood ratio", "of the median area [nat]", "slope", "weight"], rows)
