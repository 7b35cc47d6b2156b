"""A batch script that makes a release on many machines of a Slurm cluster."""

from __future__ import annotations

import shlex

SLURM = """#!/bin/bash
# An array of {count} tasks: sbatch this file. A preempted task is requeued and resumes.
#SBATCH --job-name={name}
#SBATCH --array=1-{count}
#SBATCH --cpus-per-task={cores}
#SBATCH --mem-per-cpu=4G
#SBATCH --requeue
#SBATCH --open-mode=append
set -euo pipefail

: "${{SLURM_ARRAY_TASK_ID:?submit this with sbatch}}"
if [ "$SLURM_ARRAY_TASK_ID" = 1 ]; then
  finish="{name}-finish-$SLURM_ARRAY_JOB_ID"
  if [ -z "$(squeue --noheader --name="$finish")" ]; then # not there from before a requeue
    sbatch --dependency="afterok:$SLURM_ARRAY_JOB_ID" --job-name="$finish" --requeue --wrap={finish}
  fi
fi
exec dmcvb-gen cluster part {place} "$SLURM_ARRAY_TASK_ID/{count}" --workers {cores}
"""


def script_for_slurm(count: int, cores: int, place: str) -> str:
    """A script for sbatch that makes a begun release in `count` tasks; each makes its part of the shards."""
    return SLURM.format(
        count=count,
        cores=cores,
        name="dmcvb-gen",
        place=shlex.quote(place),
        finish=shlex.quote(shlex.join(["dmcvb-gen", "cluster", "finish", place])),
    )
