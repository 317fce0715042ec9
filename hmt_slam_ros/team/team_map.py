"""The map of a team: components in pieces, each of which joins those that show the same ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces
from hmt_slam_ros.team.components import Component, Shift, combine
from hmt_slam_ros.team.join import Meeting, meet


@dataclass(frozen=True, eq=False)
class Piece:
    """Components that are joined.

    :ivar component: their common map.
    :ivar shifts: {name of a component: shift of its numbers}.
    """

    component: Component
    shifts: Mapping[str, Shift]

    @property
    def name(self) -> str:
        """The names of its components."""
        return " + ".join(self.shifts)


@dataclass(frozen=True, eq=False)
class PieceMeeting:
    """Two pieces that were compared.

    :ivar first: name of the first; ``second`` likewise.
    :ivar meeting: what was found.
    """

    first: str
    second: str
    meeting: Meeting


@dataclass(frozen=True, eq=False)
class TeamMap:
    """The map of a team.

    :ivar pieces: in the order of their first components.
    :ivar meetings: in their order.
    """

    pieces: tuple[Piece, ...]
    meetings: tuple[PieceMeeting, ...]

    def whole(self) -> Piece:
        """All pieces in one hybrid map, joined by uninformative arcs where their places are unknown."""
        whole, *others = self.pieces
        for piece in others:
            pair = combine(whole.component, piece.component)
            shifts = dict(whole.shifts) | _add_shifts(piece, pair.area_shift, pair.first_keyframe)
            whole = Piece(pair.as_one(pair.hybrid_map), shifts)
        return whole


def split_component(name: str, component: Component) -> dict[str, Component]:
    """The pieces of a map that informative arcs hold together, by names."""
    whole = component.hybrid_map
    return {
        name if n == 1 else f"{name}, piece {n}": Component.of_map(
            whole.subgraph(areas), component.scans, component.clutter
        )
        for n, areas in enumerate(map_pieces(whole), start=1)
    }


def merge_components(components: Mapping[str, Component], configuration: Configuration) -> TeamMap:
    """Join components in their order, each with the pieces that are there.

    :param components: {name: component in one piece}.
    """
    pieces: list[Piece] = []
    meetings: list[PieceMeeting] = []
    for name, component in components.items():
        newest, apart = Piece(component, {name: Shift()}), list[Piece]()
        for piece in pieces:
            found = meet(piece.component, newest.component, configuration)
            meetings.append(PieceMeeting(piece.name, newest.name, found))
            if found.joined is None:
                apart.append(piece)
                continue
            shifts = dict(piece.shifts) | _add_shifts(newest, found.pair.area_shift, found.pair.first_keyframe)
            newest = Piece(found.refine(configuration), shifts)
        pieces = [*apart, newest]
    order = list(components)
    pieces.sort(key=lambda piece: min(order.index(name) for name in piece.shifts))
    return TeamMap(tuple(pieces), tuple(meetings))


def _add_shifts(piece: Piece, areas: int, keyframes: int) -> dict[str, Shift]:
    return {name: Shift(own.areas + areas, own.keyframes + keyframes) for name, own in piece.shifts.items()}
