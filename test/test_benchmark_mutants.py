"""Mutation testing: mutants, the copy in which they are applied, and verdicts."""

import ast
import contextlib
import sys

import pytest

from benchmark.__main__ import main
from benchmark.mutants import measurement
from benchmark.mutants.measurement import Outcome, OutcomeFile, survive, try_mutant
from benchmark.mutants.mutations import (
    PACKAGE,
    Mutant,
    core_modules,
    draw_mutants,
    equivalent_reasons,
    planted_mutants,
)
from benchmark.mutants.sandbox import Sandbox, changes_kernels, find_importers, reachable
from benchmark.mutants.selection import STAGES, Baseline, Trial, near_tests, plan_far, plan_near
from hmt_slam_ros.errors import HmtSlamError

KERNELS = """from numba import njit

LIMIT = 3

@njit(cache=True)
def half(x):
    return 0.5 * x

def whole(x):
    return 2 * half(x)
"""


def make_mutant(before, after, module="motion/kernels.py", source=KERNELS):
    mutated = source.replace(before, after)
    line = next(
        n for n, pair in enumerate(zip(source.splitlines(), mutated.splitlines(), strict=True), 1) if len(set(pair)) > 1
    )
    return Mutant(module, line, before, after, "by hand", mutated)


@pytest.fixture
def sandbox(tmp_path):
    """A package of three modules, the second of which imports the first, and a test of the first."""
    for name, text in (
        ("hmt_slam_ros/__init__.py", ""),
        ("hmt_slam_ros/motion/__init__.py", ""),
        (
            "hmt_slam_ros/motion/kernels.py",
            KERNELS.replace("from numba import njit", "def njit(cache):\n    return lambda f: f\n"),
        ),
        ("hmt_slam_ros/motion/user.py", "from hmt_slam_ros.motion.kernels import half\n"),
        ("hmt_slam_ros/motion/other.py", "import math\n"),
        (
            "test/test_motion.py",
            "from hmt_slam_ros.motion.user import half\n\n\ndef test_half():\n    assert half(3) == 1.5\n",
        ),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    cache = tmp_path / "hmt_slam_ros/motion/__pycache__"
    cache.mkdir()
    for name in (
        "kernels.half-6.py311.nbi",
        "kernels.half-6.py311.1.nbc",
        "user.twice-3.py311.nbi",
        "other.f-1.py311.nbi",
    ):
        (cache / name).write_text("cached")
    with contextlib.closing(Sandbox(tmp_path)) as made:
        yield made


def list_cache(sandbox):
    return sorted(path.name for path in (sandbox.folder / "hmt_slam_ros/motion/__pycache__").glob("*.nb?"))


def test_each_planted_fault_is_python_with_one_change():
    faults = planted_mutants()
    assert len({fault.operator for fault in faults}) == len(faults) >= 7
    for fault in faults:
        ast.parse(fault.source)
        assert fault.source != (PACKAGE / fault.module).read_text()


def test_each_equivalent_mutant_is_one_of_code_that_is_there():
    for (module, before, after), reason in equivalent_reasons().items():
        lines = [line.strip() for line in (PACKAGE / module).read_text().splitlines()]
        assert set(before.splitlines()) <= set(lines), f"{module}: {before}"
        assert after != before
        assert len(reason) > 10


def test_kernels_depend_on_kernels_and_constants_but_not_on_other_functions():
    assert changes_kernels(make_mutant("0.5", "1.5"))
    assert changes_kernels(make_mutant("LIMIT = 3", "LIMIT = 4"))
    assert not changes_kernels(make_mutant("2 * half", "3 * half"))


def test_a_change_reaches_all_that_import_it_directly_or_not():
    importers = find_importers(PACKAGE)
    assert {"registration/scan_to_map.py", "loop_closure/tlca.py"} <= reachable(importers, "geometry/se2.py")
    assert "geometry/gaussian.py" not in reachable(importers, "loop_closure/tlca.py")
    # By the name that a folder passes on.
    assert "registration/scan_to_scan.py" in reachable(importers, "sensors/scan.py")


def test_while_a_mutant_is_applied_no_kernel_is_cached_that_depends_on_it(sandbox):
    before, path = list_cache(sandbox), sandbox.folder / "hmt_slam_ros/motion/kernels.py"
    original = path.read_text(), path.stat().st_mtime_ns
    with sandbox.apply(make_mutant("0.5", "1.5")):
        assert "1.5 * x" in path.read_text()
        assert list_cache(sandbox) == ["other.f-1.py311.nbi"]
        (path.parent / "__pycache__/user.twice-3.py311.nbi").write_text("compiled with the mutant")
    assert (path.read_text(), path.stat().st_mtime_ns) == original
    assert list_cache(sandbox) == before
    assert (path.parent / "__pycache__/user.twice-3.py311.nbi").read_text() == "cached"
    with sandbox.apply(make_mutant("2 * half", "3 * half")):
        assert list_cache(sandbox) == before


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [("0.5", "1.5", "killed"), ("2 * half", "3 * half", "survived"), ("return 0.5", "while True: 0.5", "timeout")],
)
def test_a_mutant_is_killed_by_a_failure_or_by_taking_too_long(sandbox, before, after, verdict):
    source = (sandbox.folder / "hmt_slam_ros/motion/kernels.py").read_text()
    limit = 3.0 if verdict == "timeout" else 60.0
    mutant = make_mutant(before, after, source=source)
    outcome = try_mutant(mutant, sandbox, Trial(("test_motion.py",), True), limit)
    assert outcome.verdict == verdict
    assert outcome.test == ("test_motion.py::test_half" if verdict == "killed" else "")
    assert outcome.seconds >= (3.0 if verdict == "timeout" else 0.0)


def test_killed_mutants_are_not_tried_again_and_survivors_are(tmp_path):
    killed, alive = make_mutant("0.5", "1.5"), make_mutant("2 * half", "3 * half")
    file = OutcomeFile(tmp_path / "outcomes.jsonl")
    for mutant, verdict in ((killed, "killed"), (alive, "survived")):
        outcome = Outcome(mutant.module, mutant.line, mutant.before, mutant.after, "by hand", verdict, "", 1.0)
        file.add(mutant, outcome)
    again = OutcomeFile(tmp_path / "outcomes.jsonl")
    assert again.get(killed).verdict == "killed"
    assert again.get(alive) is None
    assert again.get(make_mutant("0.5", "2.5")) is None


class FewInterpreted:
    """Times of tests of which one alone takes little time where kernels are interpreted."""

    def is_interpretable(self, name):
        return name == "test_geometry_se2.py"


def test_tests_that_name_most_of_a_module_come_first_and_all_run_in_the_end():
    near = near_tests("geometry/se2.py")
    assert near[0] == "test_geometry_se2.py"
    assert "test_geometry_gaussian.py" in near
    mutant, far_away = make_mutant("2 * half", "3 * half", module="geometry/se2.py"), "test_loop_closure_tlca.py"
    first, rest = plan_near(mutant, FewInterpreted()), plan_far(mutant, FewInterpreted())
    assert first == Trial(tuple(near), True)
    assert not set(first.files) & set(rest.files)
    assert {far_away, "test_places_observation.py"} <= {*first.files, *rest.files}
    kernel = make_mutant("0.5", "1.5", module="geometry/gaussian.py")
    first, own, rest = (plan(kernel, FewInterpreted()) for plan in STAGES)
    assert first == Trial(("test_geometry_se2.py",), False)
    assert own == Trial(("test_geometry_gaussian.py",), True)
    assert "test_geometry_gaussian_kernels.py" in rest.files[:10]


def test_mutants_are_drawn_from_all_modules_and_are_the_same_for_a_seed():
    pytest.importorskip(
        "cosmic_ray", reason="drawing mutants needs cosmic-ray: pip install -r requirements/mutants.txt"
    )
    modules = [module for module in core_modules() if module.startswith(("geometry", "real_time"))]
    drawn = draw_mutants(modules, 40, 0)
    assert {mutant.module for mutant in drawn} == set(modules)
    assert [mutant.key for mutant in drawn] == [mutant.key for mutant in draw_mutants(modules, 40, 0)]
    assert len({mutant.key for mutant in drawn}) == len(drawn) >= 38
    assert not {mutant.key for mutant in draw_mutants(modules, 40, 1)} >= {mutant.key for mutant in drawn}
    for mutant in drawn:
        ast.parse(mutant.source)
        assert not mutant.before.startswith("@")


def test_without_cosmic_ray_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cosmic_ray.ast", None)
    with pytest.raises(HmtSlamError, match=r"pip install -r requirements/mutants\.txt"):
        draw_mutants(["geometry/se2.py"], 10, 0)


def test_another_draw_may_be_measured(monkeypatch, tmp_path):
    seeds = []
    monkeypatch.setattr(measurement, "draw_mutants", lambda _modules, _count, seed: seeds.append(seed) or [])
    monkeypatch.setattr(measurement, "try_mutants", lambda mutants, _folder, _jobs: list(map(survive, mutants)))
    main(["mutants", "--out", str(tmp_path / "first")])
    main(["mutants", "--first-seed", "3", "--seeds", "2", "--out", str(tmp_path / "others")])
    assert seeds == [0, 3, 4]


def test_tests_run_again_without_a_mutant_where_they_or_the_package_have_changed(sandbox):
    (sandbox.folder / "test" / "test_other.py").write_text("def test_nothing():\n    assert True\n")
    runs, run = [], sandbox.run_tests
    sandbox.run_tests = lambda names, timeout, **how: runs.append(list(names)) or run(names, timeout, **how)
    names = ["test_motion.py", "test_other.py"]
    for _ in range(2):
        Baseline(sandbox).verify(names)
    assert runs == [names]
    (sandbox.folder / "test" / "test_other.py").write_text("def test_nothing():\n    assert not False\n")
    Baseline(sandbox).verify(names)
    assert runs[1:] == [["test_other.py"]]
    (sandbox.folder / "hmt_slam_ros" / "motion" / "other.py").write_text("import os\n")
    Baseline(sandbox).verify(names)
    assert runs[2:] == [names]
    kernels = sandbox.folder / "hmt_slam_ros" / "motion" / "kernels.py"
    kernels.write_text(kernels.read_text().replace("0.5", "1.5"))
    with pytest.raises(HmtSlamError, match=r"without a mutant test/test_motion\.py::test_half \(failed\)"):
        Baseline(sandbox).verify(names)
