#!/usr/bin/env bash
# Sets everything up on a fresh machine (Python 3.11, pip) and runs the checks: bash scripts/test.sh [pytest options]
extras=test
. "$(dirname "$0")/setup.sh"
ruff check .
ruff format --check .
mypy
# The tests write and remove very many small files: in memory, where there is plenty (8 GB), else on the disk.
if [ -z "${TMPDIR:-}" ] && [ "$(df --output=avail /dev/shm 2>/dev/null | tail -1)" -gt 8000000 ] 2>/dev/null; then
  TMPDIR="$(mktemp -d /dev/shm/dmcvb-XXXX)"
  export TMPDIR
  trap 'rm -rf "$TMPDIR"' EXIT
fi
# Two processes, a file of tests each at a time: more would want more memory than small machines have.
# A thread each for numerics: more than there are cores only wait for each other.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
python -m pytest -n "$(python -c 'import os; print(min(2, os.cpu_count() or 1))')" --dist loadfile "$@"
