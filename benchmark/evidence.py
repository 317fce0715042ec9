"""How far is the evidence to be believed? Its parts against the truth, on training worlds, and the constants fitted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_expit

from benchmark.report import Report, table
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_seeds, records_of
from benchmark.simulated.records import Record
from hmt_slam_ros.registration.consistency import MAPS, MAPS_USUAL, Agreement, Contradiction

SEEDS = 4
"""Training worlds of every family: 32 runs in all."""

EXTRAS, STRENGTHS, STRETCHES = (0.015, 0.03, 0.06), (50.0, 150.0, 500.0), (2.0, 5.0, 10.0)
"""Of the contradictions, all combinations of which are tried."""

_RESAMPLED = 200

POLICY = (
    "A comparison is the best way in which keyframes lie in a known area, each counted once, whichever hypotheses "
    "asked; it is true where they are there. Evidence that is stated as it should be has weight 1 in a logistic "
    "regression of the truth on it: less, and it claims too much; more, and it is too modest. Intervals hold 95 % of "
    "the weights over resampled runs. Log score: mean of -log of the probability of the truth. What contradicts is "
    "fitted by it, over all combinations of "
    f"{', '.join(f'{each:g}' for each in EXTRAS)} more contradictions in a place that looks alike, a strength of "
    f"{', '.join(f'{each:g}' for each in STRENGTHS)}, and {', '.join(f'{each:g}' for each in STRETCHES)} samples that "
    "count as one; the three best and the worst are shown."
)


class Comparison(NamedTuple):
    """The best fit of keyframes in a known area.

    :ivar run: the world.
    :ivar right: whether they are there.
    :ivar found: their surfaces in the area's map.
    :ivar look: log p(phi), nats, which the fit is not weighed by.
    :ivar rest: what else the fit is weighed by, rarity above all, nats.
    :ivar prior: log of the probability by the arcs relative to that of new ground.
    """

    run: str
    right: bool
    found: Agreement
    look: float
    rest: float
    prior: float


def measure_evidence(settings: Settings) -> Report:
    """Map training worlds, and compare what was claimed with what was true."""
    settings = replace(settings, training=True)
    comparisons = list(_comparisons(records_of(settings, count=SEEDS)))
    right = np.array([each.right for each in comparisons])
    report = Report("evidence", "What the evidence is worth", seeds=chosen_seeds(settings, SEEDS))
    counted = f"{len(comparisons)} comparisons, of which {right.sum()} are true."
    report.body += [counted, _weights_table(comparisons, right), _constants_table(comparisons, right), POLICY]
    report.data["comparisons"] = [[each.run, each.right, *each.found, *each[3:]] for each in comparisons]
    return report


def contradictions(comparisons: Sequence[Comparison], model: Contradiction) -> NDArray[np.float64]:
    """What speaks against each, nats, shape (n,)."""
    return np.array([model.log_ratio(each.found, MAPS_USUAL) for each in comparisons])


def fitted(
    evidence: NDArray[np.float64], right: NDArray[np.bool_], counted: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], float]:
    """Intercept and weights of a logistic regression, and its log score.

    :param evidence: shape (n, parts), nats.
    :param right: shape (n,).
    :param counted: how much every one counts, shape (n,); None where all count the same.
    """
    design = np.column_stack((np.ones(len(right)), evidence))
    sign = np.where(right, 1.0, -1.0)

    def surprise(weights: NDArray[np.float64]) -> float:
        return -float(np.average(log_expit(sign * (design @ weights)), weights=counted))

    found = minimize(surprise, np.zeros(design.shape[1]))
    return np.asarray(found.x), float(found.fun)


def _comparisons(records: Sequence[Record]) -> Iterator[Comparison]:
    seen: set[tuple[Any, ...]] = set()
    for record in records:
        for values in record["rows"]:
            row = dict(zip(record["columns"], values, strict=True))
            name = (record["world"], row["event"], row["known"], row["on"], row["free"])
            if row["mode"] != 0 or not row["samples"] or name in seen:
                continue
            seen.add(name)
            found = Agreement(int(row["samples"]), int(row["on"]), int(row["free"]))
            rest = row["log_weight"] - math.log(row["pi"]) - MAPS.log_ratio(found, MAPS_USUAL)
            prior = math.log(row["pi"] / row["new"])
            yield Comparison(record["world"], bool(row["right"]), found, row["look"], rest, prior)


def _weights_table(comparisons: Sequence[Comparison], right: NDArray[np.bool_]) -> str:
    parts = np.column_stack(
        (
            contradictions(comparisons, MAPS),
            [[each.look, each.rest, each.prior] for each in comparisons],
        )
    )
    together = {"what contradicts": 0, "look": 1, "rarity and distance": 2, "the arcs": 3}
    alone = {name: fitted(parts[:, [k]], right)[0][1] for name, k in together.items()}
    joint, whole = fitted(parts, right)[0][1:], fitted(parts[:, [0, 2, 3]].sum(axis=1)[:, None], right)[0][1]
    intervals = _intervals(comparisons, parts, right)
    rows = [
        [name, f"{alone[name]:.2f}", f"{joint[k]:.2f}", "{:.2f} to {:.2f}".format(*intervals[k])]
        for name, k in together.items()
    ]
    rows.append(["all of it but the look", f"{whole:.2f}", "", ""])
    return table(["evidence", "weight, alone", "together with the others", "95 % interval"], rows)


def _intervals(
    comparisons: Sequence[Comparison], parts: NDArray[np.float64], right: NDArray[np.bool_]
) -> list[tuple[float, float]]:
    """Of the weights together, over resampled runs."""
    runs = np.array([each.run for each in comparisons])
    members = {run: np.flatnonzero(runs == run) for run in np.unique(runs)}
    generator, names = np.random.default_rng(0), np.unique(runs)
    weights = []
    for _ in range(_RESAMPLED):
        chosen = np.concatenate([members[run] for run in generator.choice(names, len(names))])
        weights.append(fitted(parts[chosen], right[chosen])[0][1:])
    low, high = np.quantile(weights, (0.025, 0.975), axis=0)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def _constants_table(comparisons: Sequence[Comparison], right: NDArray[np.bool_]) -> str:
    models = [Contradiction(*each) for each in product(EXTRAS, STRENGTHS, STRETCHES)]
    scores = {}
    for model in models:
        weights, surprise = fitted(contradictions(comparisons, model)[:, None], right)
        scores[model] = (surprise, weights[1])
    ranked = sorted(models, key=lambda model: scores[model][0])
    shown = [*ranked[:3], *([MAPS] if MAPS not in ranked[:3] else []), ranked[-1]]
    rows = [
        [
            f"{model.extra:g}",
            f"{model.strength:g}",
            f"{model.stretch:g}",
            f"{scores[model][0]:.4f}",
            f"{scores[model][1]:.2f}",
            "in use" if model == MAPS else "",
        ]
        for model in shown
    ]
    return table(["extra", "strength", "stretch", "log score [nat]", "weight", ""], rows)
