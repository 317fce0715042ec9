"""The loops over beams, particles and steps take no memory, and the count detects it if they do."""

from pathlib import Path

import numpy as np
import pytest
from numba import njit
from test_registration_scan_to_map import ALIGNMENT, MODEL, ROOM, make_map, scan_surfels

from benchmark.allocations import ARRAYS, count_allocations, requirements_on
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.registration import scan_to_map

BAG = Path(__file__).resolve().parents[1] / "data" / "malaga_one_loop"
FREE = {
    "grids.patch_pool.insert_beams",
    "grids.patch_pool.patches_needed",
    "registration.scan_to_map.laplace_log_evidence",
    "registration.scan_to_map.log_prior",
}


def test_mapping_takes_no_memory_but_for_the_arrays_that_kernels_are_expected_to_make():
    log = open_log(BAG, duration=10.0)
    run_log(log, Configuration())
    with count_allocations() as counts:
        run_log(log, Configuration())
    called = {kernel for kernel, taken in counts.items() if taken}
    assert called >= FREE | {"registration.scan_to_map.propose_all"}
    assert not ARRAYS.keys() & FREE
    assert not [requirement.row for requirement in requirements_on(counts) if not requirement.is_met]


@pytest.mark.parametrize("particles", [1, 60])
@pytest.mark.parametrize("beams", [11, 361])
def test_proposals_take_their_results_alone_for_any_number_of_particles_and_beams(particles, beams):
    pool, table = make_map(ROOM, [(0, 0, 0)])
    points, poses = scan_surfels(ROOM, (0.1, 0, 0), beams=beams), np.zeros((particles, 3))
    arguments = (
        points,
        points,
        poses,
        poses,
        np.diag([100.0, 100.0, 400.0]),
        np.stack([table] * particles),
        pool.view(table),
        ALIGNMENT,
        MODEL,
        1.0,
        0.05,
    )
    scan_to_map.propose_all(*arguments)
    with count_allocations() as counts:
        scan_to_map.propose_all(*arguments)
    assert counts["registration.scan_to_map.propose_all"] == [4]


def test_a_kernel_that_takes_memory_is_found_out(monkeypatch):
    @njit
    def log_prior(pose, prior):
        difference = pose - prior.mean
        return -0.5 * np.dot(difference, prior.information @ difference)

    log_prior.py_func.__module__ = scan_to_map.__name__
    monkeypatch.setattr(scan_to_map, "log_prior", log_prior)
    prior = scan_to_map.Prior(np.zeros(3), np.eye(3))
    log_prior(np.ones(3), prior)
    with count_allocations() as counts:
        assert scan_to_map.log_prior(np.ones(3), prior) == -1.5
    assert counts["registration.scan_to_map.log_prior"] == [2]
    assert [requirement.is_met for requirement in requirements_on(counts)] == [False]
    assert scan_to_map.log_prior is log_prior
