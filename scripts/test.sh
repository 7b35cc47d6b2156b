#!/usr/bin/env bash
# Sets everything up on a fresh machine (Python 3.11, pip) and runs the checks: bash scripts/test.sh [pytest options]
extras=test
. "$(dirname "$0")/setup.sh"
ruff check .
ruff format --check .
mypy
# Two processes, a file of tests each at a time: more would want more memory than small machines have.
exec python -m pytest -n "$(python -c 'import os; print(min(2, os.cpu_count() or 1))')" --dist loadfile "$@"
