"""Do accepted closures contradict each other, and which of them is then most probably false?

A closure fits where the chi-square of all arcs does not grow by more than a quantile with its cycle. Where one that is
new does not fit, either it is false, or one that was accepted before and with it whatever was accepted because of it,
or chance has been unkind. The most probable explanation is the one of least chi-square, with the odds at which a
closure was accepted as the price of its being false:

    -2 log P = chi2 - 3 (closures left) + 2 log odds(first that is false) + const

What was accepted after a false closure was judged by a false map; of these, all that do not fit are false for nothing.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.processes.closure_account import Account, Closure, Name, as_measured, unrefined, without
from hmt_slam_ros.topology.global_map import contradiction

_DEGREES_OF_FREEDOM = 3


class Explanation(NamedTuple):
    """One way in which closures that contradict each other go together.

    :ivar account: the path without what is false.
    :ivar false: the closures that are false, in the order of acceptance.
    :ivar probability: that this is so.
    """

    account: Account
    false: tuple[Closure, ...]
    probability: float


class Doubt(NamedTuple):
    """A closure that does not fit.

    :ivar closure: the new closure.
    :ivar excess: by how much the chi-square grows with it.
    :ivar explanations: of that, the most probable first.
    """

    closure: Closure
    excess: float
    explanations: tuple[Explanation, ...]


class Doubts:
    """Looks for contradictions in one account.

    :param bound: the quantile of chi-square.
    :param new_area: the first number that no area has.
    """

    def __init__(self, account: Account, bound: float, new_area: int) -> None:
        self._account = account
        self._bound = bound
        self._new_area = new_area
        self._accounts: dict[frozenset[Name], Account] = {}
        self._chi2: dict[frozenset[Name], float] = {}

    def raised(self, new: Collection[Name], least: float) -> Doubt | None:
        """The contradiction that new closures bring, or None.

        :param least: explanations less probable are left out.
        """
        excess = {closure: self._excess(closure, frozenset()) for closure in self._closures(new)}
        worst = max(excess, key=lambda closure: excess[closure], default=None)
        if worst is None or excess[worst] <= self._bound:
            return None
        return Doubt(worst, excess[worst], tuple(self._explanations(worst, least)))

    def _explanations(self, doubted: Closure, least: float) -> list[Explanation]:
        costs = {frozenset[Name](): self._cost(frozenset())}
        for root in self._account.closures:
            false = self._false_with(root, doubted)
            if false is not None:
                cost = self._cost(false) + 2.0 * root.log_odds
                costs[false] = min(cost, costs.get(false, np.inf))
        weights = np.exp(-0.5 * (np.array(list(costs.values())) - min(costs.values())))
        found = [
            Explanation(self._without(false), self._closures(false), float(probability))
            for false, probability in zip(costs, weights / weights.sum(), strict=True)
            if probability >= least
        ]
        return sorted(found, key=lambda explanation: -explanation.probability)

    def _false_with(self, root: Closure, doubted: Closure) -> frozenset[Name] | None:
        """What is false where ``root`` is the first that is; None where that does not explain the doubt."""
        order = [closure.name for closure in self._account.closures]
        later = [name for name in order[order.index(root.name) + 1 :] if name != doubted.name]
        false = frozenset({root.name, *later})
        if root is not doubted and self._excess(doubted, false) > self._bound:
            return None
        for name in later:
            closure = self._closures({name})[0]
            if self._excess(closure, false - {name}) <= self._bound:
                false -= {name}
        return false if self._excess(root, false - {root.name}) > self._bound else None

    def _closures(self, names: Collection[Name]) -> tuple[Closure, ...]:
        return tuple(closure for closure in self._account.closures if closure.name in names)

    def _excess(self, closure: Closure, false: frozenset[Name]) -> float:
        """By how much the chi-square grows with a closure, where others are false."""
        return self._contradiction(false) - self._contradiction(false | {closure.name})

    def _cost(self, false: frozenset[Name]) -> float:
        return self._contradiction(false) - _DEGREES_OF_FREEDOM * len(self._without(false).closures)

    def _contradiction(self, false: frozenset[Name]) -> float:
        if false not in self._chi2:
            self._chi2[false] = contradiction(as_measured(self._without(false)))
        return self._chi2[false]

    def _without(self, false: frozenset[Name]) -> Account:
        """The account without some closures; what hangs on several of them hangs on the last."""
        if false not in self._accounts:
            account, new_area, closures = self._account, self._new_area, self._closures(false)
            account = unrefined(account, closures[0].name) if closures else account
            for closure in reversed(closures):
                account = without(account, closure.name, new_area)
                new_area += 1
            self._accounts[false] = account
        return self._accounts[false]
