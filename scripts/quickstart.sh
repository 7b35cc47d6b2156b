#!/usr/bin/env bash
# Sets everything up on a fresh machine (Python 3.11, pip), makes a small release, shows and validates it.
#   bash scripts/quickstart.sh [OUT]      OUT: the release's folder, releases/quickstart by default
out="${1:-releases/quickstart}"
case "${1:-/}" in /*) ;; *) out="$PWD/$1" ;; esac # setup.sh goes to the repository
extras=train
. "$(dirname "$0")/setup.sh"
dmcvb-gen rollout --recipe quickstart --out "$out" --workers "$(python -c 'import os; print(min(4, os.cpu_count() or 1))')"
dmcvb-gen info "$out"
dmcvb-gen preview "$out"
dmcvb-gen validate "$out" --checks-only --out reports/quickstart
