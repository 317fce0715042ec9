"""A fault at calls that write: what is there afterwards is the old, or the new, and the next run clears the rest."""

import pytest

from benchmark.fuzz.seeds import write_seeds
from benchmark.write_faults.measurement import OPERATIONS, try_operations

FULL_DISK, KILLED_AFTER = "0", "5"
"""Numbers in `benchmark.write_faults.trial.FAULTS`."""

PARTS, COMMANDS = ("file", "folder", "journal"), ("convert to mcap", "convert to sqlite3", "plot", "export")


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults") / "seeds"
    write_seeds(folder)
    return folder


def test_all_operations_are_tried_but_the_longest():
    assert {*PARTS, *COMMANDS} == set(OPERATIONS) - {"map"}, "map writes as 'folder' does"


def test_a_fault_at_a_call_that_writes_leaves_the_old_or_the_new(seeds, tmp_path):
    found = try_operations(tmp_path, seeds, PARTS, "--every", "11")
    assert min(found["trials"].values()) >= 24
    assert found["breaches"] == []


def test_a_full_disk_or_a_kill_leaves_the_old_or_the_new_of_a_command(seeds, tmp_path):
    found = try_operations(tmp_path, seeds, COMMANDS, "--every", "60", "--faults", FULL_DISK, KILLED_AFTER)
    assert min(found["trials"].values()) >= 6
    assert found["breaches"] == []
