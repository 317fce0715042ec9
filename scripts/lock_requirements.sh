#!/usr/bin/env bash
# Writes requirements/*.txt from requirements/*.in: every package that is installed, with its version and hashes, for
# Python 3.11 and 3.12 and all platforms. Versions that fit stay as they are.
# Usage: scripts/lock_requirements.sh [further arguments of `uv pip compile`, such as --upgrade or --upgrade-package NAME]
#   It needs uv (pip install uv) and PyPI.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

export UV_CUSTOM_COMPILE_COMMAND=scripts/lock_requirements.sh
constraints=()
for name in tested ros tf2_msgs; do
    uv pip compile --quiet --no-config --universal --python-version 3.11 --generate-hashes \
        --default-index https://pypi.org/simple ${constraints[@]+"${constraints[@]}"} \
        --output-file "requirements/$name.txt" "requirements/$name.in" "$@"
    constraints+=(--constraints "requirements/$name.txt")
done
