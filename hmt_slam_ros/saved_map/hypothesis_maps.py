"""The maps of the hypotheses in a saved state, as far as other values refer to them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.saved_map.field_limits import require
from hmt_slam_ros.untrusted_input import shorten


class HypothesisMap(NamedTuple):
    """Areas, keyframes and arcs of one hypothesis.

    :ivar areas: ids.
    :ivar keyframes: shape (k,), ids, area by area.
    :ivar arcs: pairs of areas, the smaller first.
    """

    areas: frozenset[int]
    keyframes: NDArray[np.int64]
    arcs: frozenset[tuple[int, int]]


def hypothesis_map(replica: Any, hypothesis: int) -> HypothesisMap:  # noqa: ANN401  a ReplicaState
    """The map of a hypothesis: the common one with the areas and arcs that differ."""
    common, change = replica.common, replica.changes[hypothesis]
    is_kept = ~np.isin(common.areas, change.areas)
    keyframes = common.keyframes[np.repeat(is_kept, common.keyframe_counts)]
    removed = frozenset(map(tuple, change.arcs[change.removed].tolist()))
    arcs = frozenset(map(tuple, common.arcs.tolist())) | frozenset(map(tuple, change.arcs.tolist()))
    return HypothesisMap(
        frozenset([*common.areas.tolist(), *change.areas.tolist()]),
        np.concatenate((keyframes, change.keyframes)),
        arcs - removed,
    )


def check_hypothesis_maps(replica: Any, path: str) -> None:  # noqa: ANN401  a ReplicaState
    """Check that each hypothesis has its keyframes in one area each, and all areas joined by arcs.

    :param path: of the replica in its document.
    :raises HmtSlamError: names the field and what is wrong.
    """
    for graph in (replica.common, *replica.changes.values()):
        require(bool((graph.keyframe_counts > 0).all()), f"{path}.keyframe_counts", 0, "1 or more in each area")
    for hypothesis in replica.changes:
        own = hypothesis_map(replica, hypothesis)
        require(np.unique(own.keyframes).size == own.keyframes.size, f"{path}.keyframes", "one twice", "one of each")
        apart = own.areas - _joined_areas(own)
        require(not apart, f"{path}.arcs", f"none to {shorten(sorted(apart))}", "a way along arcs to every area")


def _joined_areas(own: HypothesisMap) -> set[int]:
    """The areas that arcs join with the one of the smallest id."""
    neighbors = defaultdict[int, list[int]](list)
    for a, b in own.arcs:
        neighbors[a].append(b)
        neighbors[b].append(a)
    pending = [min(own.areas)] if own.areas else []
    joined = set(pending)
    while pending:
        new = [area for area in neighbors[pending.pop()] if area not in joined]
        joined.update(new)
        pending += new
    return joined


def require_areas(own: HypothesisMap, areas: Iterable[int], path: str) -> None:
    """Check that areas are in the map of a hypothesis.

    :raises HmtSlamError: names the field and those that are not.
    """
    missing = set(areas) - own.areas
    require(not missing, path, shorten(sorted(missing)), "areas of the hypothesis")


def require_keyframes(own: HypothesisMap, keyframes: Iterable[int], path: str) -> None:
    """Check that keyframes are in the map of a hypothesis.

    :raises HmtSlamError: names the field and those that are not.
    """
    missing = set(keyframes) - set(own.keyframes.tolist())
    require(not missing, path, shorten(sorted(missing)), "keyframes of the hypothesis")
