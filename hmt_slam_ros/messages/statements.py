"""Statements of people about places, and their probabilities (docs/decisions/0081-statements.md)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from hmt_slam_ros.configuration.topology import InferenceParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.same_place import areas_of, middle_keyframe, same_place_probability
from hmt_slam_ros.untrusted_input import shorten

StatementKind = Literal["same", "different", "refused"]
StatementOutlook = Literal["new", "open", "true", "false"]

RELIABILITY = 0.95
"""Reliability of a statement that names none."""

MIN_RELIABILITY, MAX_RELIABILITY = 0.5, 0.999
"""Bounds of a reliability: at the first a statement tells nothing, beyond the second nobody is that sure of a place."""

MAX_AREA_NUMBER = 2**31 - 1

_FORM = re.compile(
    r"(?P<kind>same|different|refused) (?P<first>\d{1,10}) (?P<second>\d{1,10})"
    r"(?: by (?P<author>[^\s]{1,100}))?(?: at (?P<reliability>\d?\.?\d{1,6}))?"
)
_REMEDY = "write same, different or refused, two numbers of areas, and if you like 'by' a name and 'at' a reliability"


@dataclass(frozen=True, slots=True)
class PlaceStatement:
    """To tsbi: what a person states about two areas of the map.

    :ivar kind: "same" where both are one place, "different" where they are two, "refused" where the closure between
        them is false.
    :ivar first: id of an area.
    :ivar second: id of the other one.
    :ivar author: name of the person, empty where none was given.
    :ivar reliability: probability that such a statement of theirs is true, 0.5 to 0.999.
    """

    kind: StatementKind
    first: int
    second: int
    author: str = ""
    reliability: float = RELIABILITY


@dataclass(frozen=True, slots=True)
class WeighedStatement:
    """A statement with its probability under the live hypotheses.

    :ivar number: of the statement, 1, 2, ... in the order in which they came.
    :ivar event: the keyframe event at which it was weighed first.
    :ivar statement: with the ids that the areas had then.
    :ivar first_keyframe: the keyframe that stands for the first area.
    :ivar second_keyframe: the keyframe that stands for the second area.
    :ivar probability: that it is true, the sum over the hypotheses under which it is.
    :ivar outlook: "true" from a probability of 0.95 on, "false" up to 0.05, "open" between; "new" before the first.
    """

    number: int
    event: int
    statement: PlaceStatement
    first_keyframe: int
    second_keyframe: int
    probability: float = 0.0
    outlook: StatementOutlook = "new"

    def areas_in(self, hybrid_map: HybridMap) -> tuple[int, int] | None:
        """The areas of both keyframes in a map, None where it lacks one."""
        areas = areas_of(hybrid_map, (self.first_keyframe, self.second_keyframe))
        return (areas[self.first_keyframe], areas[self.second_keyframe]) if len(areas) == 2 else None

    def __str__(self) -> str:
        statement = self.statement
        author, areas = statement.author or "a person", f"areas {statement.first} and {statement.second}"
        if statement.kind == "refused":
            return f"{author} refuses the closure between {areas}"
        places = "the same place" if statement.kind == "same" else "different places"
        return f"{author} states that {areas} are {places}"


def check_statement(statement: PlaceStatement) -> PlaceStatement:
    """The statement, where it can be weighed.

    :raises HmtSlamError: names the field, its value and the remedy.
    """
    first, second, author = statement.first, statement.second, statement.author
    for area in (first, second):
        _require(0 <= area <= MAX_AREA_NUMBER, "area", area, "the id of an area")
    _require(first != second, "second", second, "another area than the first")
    _require(len(author) <= 100 and (not author or author.isprintable()), "author", shorten(author), "a name")
    is_reliability = MIN_RELIABILITY <= statement.reliability <= MAX_RELIABILITY
    _require(is_reliability, "reliability", statement.reliability, f"from {MIN_RELIABILITY} to {MAX_RELIABILITY}")
    return statement


def standing_keyframe(statement: PlaceStatement, hybrid_map: HybridMap, area: int) -> int | None:
    """The keyframe that stands for an area of a statement; None where the map has no such area with keyframes.

    A false closure adds keyframes to the known area, so that the oldest stands for an area whose closure is refused.
    """
    if not hybrid_map.has_area(area):
        return None
    if statement.kind == "refused":
        return min(hybrid_map.keyframes(area), key=lambda k: (k < 0, k), default=None)
    return middle_keyframe(hybrid_map, area)


class StatementEvidence:
    """The evidence of statements for a map: P(statement | map) = r p + (1 - r)(1 - p).

    r is the reliability of the statement, and p the probability that it is true in the map.
    """

    def __init__(self, options: InferenceParameters) -> None:
        self._radius, self._scale = options.place_radius, options.prior_scale

    def probability(self, hybrid_map: HybridMap, weighed: WeighedStatement) -> float:
        """The probability that a statement is true if a map is."""
        if weighed.statement.kind == "refused":
            return 0.0 if self._is_closed(hybrid_map, weighed) else 1.0
        keyframes = weighed.first_keyframe, weighed.second_keyframe
        same = same_place_probability(hybrid_map, *keyframes, self._radius, self._scale)
        return same if weighed.statement.kind == "same" else 1.0 - same

    def log_likelihood(self, hybrid_map: HybridMap, statements: Iterable[WeighedStatement]) -> float:
        """The log-likelihood of independent statements, nats."""
        return sum(self._log_likelihood(hybrid_map, weighed) for weighed in statements)

    def _log_likelihood(self, hybrid_map: HybridMap, weighed: WeighedStatement) -> float:
        reliability, true = weighed.statement.reliability, self.probability(hybrid_map, weighed)
        return math.log(reliability * true + (1.0 - reliability) * (1.0 - true))

    @staticmethod
    def _is_closed(hybrid_map: HybridMap, weighed: WeighedStatement) -> bool:
        areas = weighed.areas_in(hybrid_map)
        if areas is None or areas[0] == areas[1]:
            return areas is not None
        value = hybrid_map.arc_value(*areas)
        return value is not None and value.closure


def parse_statement(text: str) -> PlaceStatement:
    """The statement of a text such as "same 3 56 by ann at 0.9".

    :raises HmtSlamError: where the text is none.
    """
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise HmtSlamError(f"'{shorten(text)}' is no statement about two areas: {_REMEDY}")
    kind = next(kind for kind in get_args(StatementKind) if kind == found["kind"])
    reliability = RELIABILITY if found["reliability"] is None else float(found["reliability"])
    statement = PlaceStatement(kind, int(found["first"]), int(found["second"]), found["author"] or "", reliability)
    return check_statement(statement)


def _require(holds: bool, name: str, value: object, wanted: str) -> None:
    if not holds:
        raise HmtSlamError(f"{name} = {value} of a statement is not {wanted}: {_REMEDY}")
