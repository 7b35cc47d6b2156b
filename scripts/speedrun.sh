#!/usr/bin/env bash
# Trains a task from nothing until a policy reaches 95 % of the paper's expert, and prints its row for docs/results.md.
#   bash scripts/speedrun.sh walker-walk [--seed N] [--set KEY=VALUE]...
extras=train
. "$(dirname "$0")/setup.sh"
export OMP_NUM_THREADS=1
exec python scripts/speedrun.py "$@"
