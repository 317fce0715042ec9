# Sourced by the other scripts: makes the virtual environment where it is missing or stale, and sets `venv`, its
# folder. The environment's Python is $PYTHON, else the first of python3, python3.12 and python3.11 that is 3.11 or 3.12.
# Usage: . environment.sh [--floor]

supported_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.12 python3.11}; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' 2>/dev/null; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    echo "No Python 3.11 or 3.12 was found${PYTHON:+ at PYTHON=$PYTHON}; install one, or name it with PYTHON=..." >&2
    return 2
}

make_environment() {
    local python interpreter
    python=$(supported_python) || exit
    interpreter=$("$python" "$(dirname "${BASH_SOURCE[0]}")/environment.py" "$@" </dev/null) || exit
    venv=$(dirname "$(dirname "$interpreter")")
}
