#!/usr/bin/env bash
# Sets everything up on a fresh machine (Python 3.11, pip) and runs the checks.
#   bash scripts/test.sh [pytest options]          the linters and the fast tests: about 4 minutes on two cores
#   bash scripts/test.sh --all [pytest options]    the slow tests too
#   bash scripts/test.sh --full [pytest options]   every test: pages, examples, the suite, emulated processors, every kill
# Tests without the mark slow that compute for more than 2.5 s are listed at the end.
tier=(-m "not slow" --cpu-limit 2.5)
if [ "${1:-}" = --all ]; then
  tier=(-m "not full")
  shift
elif [ "${1:-}" = --full ]; then
  tier=()
  shift
fi
extras=test
. "$(dirname "$0")/setup.sh"
ruff check .
ruff format --check .
mypy
# The tests write and remove many small files: in memory if 8 GB are free there, else on the disk.
if [ -z "${TMPDIR:-}" ] && [ "$(df --output=avail /dev/shm 2>/dev/null | tail -1)" -gt 8000000 ] 2>/dev/null; then
  TMPDIR="$(mktemp -d /dev/shm/dmcvb-XXXX)"
  export TMPDIR
  trap 'rm -rf "$TMPDIR"' EXIT
fi
# Two processes: more would need more memory than small machines have. Who has no tests left takes some of the other's.
# One thread each for numerics: more threads than cores only wait for each other.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
python -m pytest -n "$(python -c 'import os; print(min(2, os.cpu_count() or 1))')" --dist worksteal \
  --cpu-times 60 "${tier[@]}" "$@"
