"""A short run of the fuzzer: whatever a file holds, a command accepts it, or refuses it in one sentence."""

import shutil
import time

import numpy as np
import pytest

from benchmark.fuzz.crafted import crafted_cases, run_subprocess
from benchmark.fuzz.isolation import Verdict, judge, run_command
from benchmark.fuzz.measurement import mutated_runs
from benchmark.fuzz.mutations import mutate_bytes, mutate_lines
from benchmark.fuzz.tampering import MAP, STATE, tamper_with_map
from benchmark.fuzz.targets import CORPUS, TARGETS, accepts, corpus
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.results.hmt_map import read_run_state, read_saved_map

_SECONDS = 0.5
"""Of each target."""

_SLOW = {"bomb of gzip", "bomb of gzip of zeros", "bomb of xz", "line of 100 MB, packed", "report of 60 MB"}
"""Hostile files that take seconds to make."""


@pytest.mark.parametrize(("kind", "count"), [("readers", 24), ("yaml", 20)])
def test_no_mutated_file_ends_a_command_but_in_one_sentence(fuzz_seeds, kind, count):
    faults = [run for run in mutated_runs(kind, fuzz_seeds, count, seed=26) if run.answer.verdict.is_fault]
    assert not faults, "\n".join(f"{run.case}, run {run.number}: {run.answer.place}" for run in faults)


def test_the_sentence_on_missing_memory_counts_as_out_of_memory():
    assert (
        judge(2 << 8, "hmt_slam map: there is no memory left: give a smaller input, or free some\n") is Verdict.MEMORY
    )
    assert judge(2 << 8, "hmt_slam map: the log is empty: give another\n") is Verdict.REFUSED


@pytest.mark.parametrize("documents", [MAP, STATE])
def test_a_map_with_other_values_is_read_or_refused_in_one_sentence(fuzz_seeds, tmp_path, documents):
    refused = 0
    for number in range(16):
        folder = tmp_path / str(number)
        shutil.copytree(fuzz_seeds / "map" / "out" / "hmt_map", folder)
        tamper_with_map(folder, np.random.default_rng([26, number]), documents)
        try:
            read_saved_map(folder)
            read_run_state(folder)
        except HmtSlamError:
            refused += 1
    assert 2 <= refused < 16


@pytest.mark.parametrize("target", TARGETS)
def test_a_reader_accepts_its_seeds_and_refuses_what_once_was_a_fault(target):
    for path in sorted((CORPUS / target).iterdir()):
        is_seed = path.name.startswith("seed") and target != "manifest"  # a manifest is none without its files
        assert accepts(target, path.read_bytes()) or not is_seed, path.name


@pytest.mark.parametrize("target", TARGETS)
def test_a_reader_has_no_answer_but_yes_and_one_sentence(target):
    rng, contents = np.random.default_rng(26), corpus(target)
    end = time.process_time() + _SECONDS
    while time.process_time() < end:
        content = contents[rng.integers(len(contents))]
        accepts(target, (mutate_bytes if rng.random() < 0.6 else mutate_lines)(content, rng))


@pytest.mark.parametrize("group", ["mcap", "sqlite", "bag folder", "carmen", "rawlog", "places", "worlds"])
def test_hostile_files_are_refused_in_time_and_memory(fuzz_seeds, tmp_path, group):
    cases = [case for case in crafted_cases() if case.group == group and case.name not in _SLOW]
    for number, case in enumerate(cases[::3]):
        folder = tmp_path / str(number)
        folder.mkdir()
        answer = case.run(folder, fuzz_seeds, run_command)
        assert not answer.verdict.is_fault, f"{case.name}, {case.command[0]}: {answer.verdict.value} {answer.text}"


@pytest.mark.parametrize("name", ["quality of service 1", "messages without end", "pipe", "line of 20 MB"])
def test_the_command_itself_refuses_in_one_sentence(fuzz_seeds, tmp_path, name):
    case = next(case for case in crafted_cases() if case.name == name)
    answer = case.run(tmp_path, fuzz_seeds, run_subprocess)
    assert answer.verdict.value == "refused in one sentence"
    assert len(answer.text.strip().splitlines()) == 1, answer.text
