"""A fault at calls that write: what is there afterwards is the old, or the new, and the next run clears the rest."""

import pytest

from benchmark.write_faults.measurement import OPERATIONS, try_operations

FULL_DISK, KILLED_AFTER, NO_EXCHANGE = "0", "5", "8"
"""Numbers in `benchmark.write_faults.trial.FAULTS`."""

PARTS = ("file", "folder", "journal", "save", "save while localized")
COMMANDS = ("convert to mcap", "convert to sqlite3", "plot", "export")


def test_all_operations_are_tried_but_the_longest():
    assert {*PARTS, *COMMANDS} == set(OPERATIONS) - {"map"}, "map writes as 'folder' does"


def test_a_fault_at_a_call_that_writes_leaves_the_old_or_the_new(fuzz_seeds, tmp_path):
    found = try_operations(tmp_path, fuzz_seeds, PARTS, "--every", "23")
    assert min(found["trials"].values()) >= 24
    assert found["breaches"] == []


def test_a_faulty_disk_that_cannot_exchange_two_names_leaves_the_old_or_the_new(fuzz_seeds, tmp_path):
    found = try_operations(tmp_path, fuzz_seeds, ("folder",), "--faults", NO_EXCHANGE)
    assert found["trials"]["folder"] >= 40
    assert found["breaches"] == []


@pytest.mark.long
def test_a_full_disk_or_a_kill_leaves_the_old_or_the_new_of_a_command(fuzz_seeds, tmp_path):
    found = try_operations(tmp_path, fuzz_seeds, COMMANDS, "--every", "60", "--faults", FULL_DISK, KILLED_AFTER)
    assert min(found["trials"].values()) >= 6
    assert found["breaches"] == []
