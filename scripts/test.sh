#!/usr/bin/env bash
# Sets everything up on a fresh machine (Python 3.11, pip) and runs the checks: bash scripts/test.sh [pytest options]
extras=test
. "$(dirname "$0")/setup.sh"
ruff check .
ruff format --check .
mypy
exec python -m pytest "$@"
