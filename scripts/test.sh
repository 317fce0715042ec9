#!/usr/bin/env bash
# Makes the environment where it is missing and passes the tests.
# Usage: scripts/test.sh [--floor] [pytest arguments], such as -k NAME for a part of them
#   Without pytest arguments the long tests are left out (-m long runs them), and the accuracy is compared with
#   benchmark/expected.toml after the tests.
#   --floor  with the oldest versions supported (requirements/floor.txt), in .venv-floor, without ruff and mypy
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/environment.sh

status=0
check() {
    echo "== $*"
    "$venv/bin/python" -m "$@" || status=1
}

# Two workers for the tests of nodes, which often wait, and one for those that only compute (test/conftest.py). Nodes have
# to react within a time that the other workers may take from them: of these, what fails has to pass alone.
test_all() {
    echo "== pytest -n 3"
    "$venv/bin/python" -m pytest --cache-clear -n 3 --max-worker-restart 2 -m "not long" && return
    "$venv/bin/python" -m pytest -q --collect-only --last-failed --last-failed-no-failures none -m "not nodes"
    [ "$?" = 5 ] || status=1
    echo "the tests of nodes above that failed beside others run once more, alone"
    check pytest --last-failed --last-failed-no-failures none -m nodes
}

# What each worker would otherwise compile at the same time: kernels, and the tests with pytest's assertions.
compile_all() {
    "$venv/bin/hmt_slam" compile >/dev/null 2>&1
    "$venv/bin/python" -m pytest --collect-only -q >/dev/null 2>&1
}

# Where it is set, each of some hundred programs that tests start compiles the sources of the package.
unset PYTHONDONTWRITEBYTECODE

if [ "${1:-}" = --floor ]; then
    shift
    make_environment --floor
    # The caches of two numba versions beside the same sources would drive each other out.
    export NUMBA_CACHE_DIR="$venv/numba_cache"
else
    make_environment
    # While mypy reads.
    [ "$#" != 0 ] || compile_all &
    check ruff check
    check ruff format --check
    check mypy
    echo "== lint-imports"
    PYTHONPATH=. "$venv/bin/lint-imports" --no-logo || status=1
    wait
    [ "$status" = 0 ] || echo "ruff or mypy found faults, see above; the tests run all the same"
fi

# Misspelled message fields and wrong types fail; nodes of other machines on the network are not seen.
export ROS_PYTHON_CHECK_FIELDS=1 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
if [ "$#" != 0 ]; then
    check pytest "$@"
else
    test_all
    check benchmark short
fi
exit "$status"
