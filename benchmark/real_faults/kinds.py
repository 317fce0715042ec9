"""All kinds of faults."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from benchmark.real_faults import obstructions, odometry_faults, scan_faults
from benchmark.real_faults.stream import Fault
from benchmark.real_faults.stretches import FINE_BEAMS, FULL_TURN, SOURCES


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    :ivar name: of one word.
    :ivar plant: plants it.
    :ivar sources: of the stretches in which it can be planted.
    :ivar subjects: of findings of the doctor that name it; none where it is no fault of the odometry or of stamps.
    """

    name: str
    plant: Fault
    sources: tuple[str, ...] = SOURCES
    subjects: tuple[str, ...] = ()

    def random(self, log: str, seed: int) -> np.random.Generator:
        """The generator for a seed, another one for every log, by its name."""
        return np.random.Generator(np.random.Philox(key=[seed, zlib.crc32(f"{self.name} {log}".encode())]))

    @property
    def description(self) -> str:
        """What is done, in a sentence."""
        return (self.plant.__doc__ or "").strip()


KINDS = (
    Kind("frozen-in-turns", odometry_faults.freeze_in_turns, subjects=("odometry frozen",)),
    Kind("frozen-on-straights", odometry_faults.freeze_on_straights, subjects=("odometry frozen",)),
    Kind("jumps", odometry_faults.jump, subjects=("odometry jumps",)),
    Kind("resets", odometry_faults.reset_to_zero, subjects=("odometry jumps",)),
    Kind("turn-scale", odometry_faults.scale_turns, subjects=("rotation scale",)),
    Kind("clock-offset", odometry_faults.offset_clock, subjects=("clock offset",)),
    Kind("batches", odometry_faults.deliver_in_batches, subjects=("odometry batches",)),
    Kind("gap-in-motion", scan_faults.drop_scans_in_motion, subjects=("scan gaps",)),
    Kind("gap-at-rest", scan_faults.pause, subjects=("scan gaps",)),
    Kind("one-hertz", scan_faults.scan_slowly),
    Kind("one-degree", scan_faults.thin_to_one_degree, FINE_BEAMS),
    Kind("beam-count", scan_faults.vary_beam_count),
    Kind("short-reach", scan_faults.shorten_reach),
    Kind("narrow-view", scan_faults.narrow_view, FULL_TURN),
    Kind("empty-scans", scan_faults.empty_some_scans),
    Kind("doorways", obstructions.narrow_doorways),
    Kind("crowds", obstructions.crowd),
)

BY_NAME = {kind.name: kind for kind in KINDS}
