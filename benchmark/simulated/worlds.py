"""Which simulated worlds are mapped, and by which seeds.

The model of the inference is fitted on training seeds alone. docs/reports/validation.md has validation seeds only; they
choose nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.errors import HmtSlamError

TRAINING_SEEDS = range(100)
FIRST_VALIDATION_SEED = 1000

SETTINGS = {
    "office": "size=0.7",
    "busy": "size=0.7",
    "nested": "",
    "grid": "size=0.7",
    "ring": "",
    "straight": "size=0.7",
    "hall": "size=0.7,laps=2",
    "twins": "size=0.7",
}
"""{family: settings of its worlds}; smaller ones where that leaves what the family is for."""

FAMILIES = tuple(SETTINGS)

LONG = "long"
"""2 km of nested loops; mapped only on request by its name."""

INSTITUTE = "institute"
"""Hallways with open and closed doors and crossings, for what is measured there alone."""

_OTHERS = {LONG: "sim:nested,seed={},size=3.3", INSTITUTE: "sim:institute,seed={}"}


@dataclass(frozen=True)
class World:
    """A simulated drive, and the seed of building, noise and run alike.

    :ivar family: one of ``FAMILIES``, or ``LONG``, or ``INSTITUTE``.
    :ivar more: further settings of the world.
    """

    family: str
    seed: int
    more: str = ""

    @property
    def log(self) -> str:
        """The name that ``open_simulated`` takes."""
        if self.family in _OTHERS:
            return _OTHERS[self.family].format(self.seed)
        return ",".join(filter(None, (f"sim:{self.family},seed={self.seed}", SETTINGS[self.family], self.more)))

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.family}-{self.seed}"


def seeds(count: int, first_seed: int = 0, *, training: bool) -> tuple[int, ...]:
    """Seeds for training or for validation.

    :param first_seed: the first of them; 0 for the usual one.

    :raises HmtSlamError: where there are fewer.
    """
    if training and first_seed + count > len(TRAINING_SEEDS):
        raise HmtSlamError(f"there are {len(TRAINING_SEEDS)} training seeds: {first_seed + count} are too many")
    first = first_seed or (TRAINING_SEEDS.start if training else FIRST_VALIDATION_SEED)
    return tuple(range(first, first + count))


CAMPUS = "campus"
"""The world of ``LONG`` that is compared with a metric map."""

CAMPUS_WORLD = World(LONG, FIRST_VALIDATION_SEED).log
"""2 km of way through loops of corridors, one inside the other."""
